"""Is a guide worth it? A few short trainings beside the guide, a table, and a recommendation.

`comparison` puts it together: `arms` says what learns, `timing` how long it takes, `jobs` trains,
`baselines` has what acts without learning, `outcome` reads the results, `verdict` is the rule, and
`page` the text and the picture.
"""
