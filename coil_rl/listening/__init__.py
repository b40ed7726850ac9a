"""Analysis of how much a trained agent uses the advice of each guide, and where on the track."""
