"""Is a guide worth it? A few short trainings beside the guide, a table, and a recommendation.

`compare` puts it together: `arms` says what learns, `timing` how long it takes, `same` keeps the
plan, `jobs` trains, `baselines` has what acts without learning, `outcome` reads the results,
`entry` compares two of them, `verdict` is the rule, `sentences` what it says, and `page` the text
and the picture.
"""
