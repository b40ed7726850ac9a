"""Is a guide worth it? A few short trainings beside the guide, a table, and a recommendation.

`coil_rl.worth.comparison` runs them, `arms` says which there are, `timing` how long they take,
`baselines` what acts without learning, `outcome` reads the results, `verdict` has the rule, and
`page` the table and the picture.
"""
