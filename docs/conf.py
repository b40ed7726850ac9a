"""Sphinx: the pages of this folder, and those of the checkout that they link to, as a site.

`make docs` builds it into build/docs. The source folder is that of the checkout, so that a link
leads to the same file here and in the repository.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import coil_rl

project = "coil-rl"
version = release = coil_rl.versions()["coil-rl"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "generated",  # generated.py beside this file
]
root_doc = "docs/index"
# The notebook of the docs is a text, so that a change of it can be read.
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
source_suffix = {".md": "myst-nb", ".py": "myst-nb"}
include_patterns = [
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
    "docs/guide_benchmark/*.md",
    "docs/methods/*.md",
    "docs/notebooks/*.py",
    "paper/README.md",
    "paper/results/*.md",
]
exclude_patterns = [".git", ".venv", "build", "outputs", "tests"]

# Text
default_role = "code"  # `name` in a docstring
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

# Code
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_use_ivar = True  # attributes once, in the docstring of their class
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parents[1] / "build" / "notebooks")
nb_execution_raise_on_error = True
nb_execution_timeout = 1200  # seconds a cell, also on a busy machine
nb_merge_streams = True
nb_output_stderr = "remove"  # progress bars

suppress_warnings = ["myst.header"]  # the pages of the paper's results begin below a common title

# Pages: what they load lies beside them.
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["wide.css"]
highlight_language = "text"  # of a block that names none: mostly commands
html_title = "coil-rl"
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_show_copyright = False
html_additional_pages = {"index": "start.html"}  # the site begins in docs/
templates_path = ["templates"]
