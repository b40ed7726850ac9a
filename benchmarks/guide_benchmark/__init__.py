"""The guide benchmark: its pages, its table of rows, and tasks of other packages.

Each of these tasks is one file, `tasks_PACKAGE.py`, with an env and its controller, and a file in
`conf/task` and in `conf/experiment/guide_benchmark`. docs/guide_benchmark.md says how to run them.
"""
