"""Sphinx settings: `make docs` builds the site from docs/ and the pages of the repository's root."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

_HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(_HERE))

project = "bathynerf"
author = "the bathynerf contributors"
copyright = "the bathynerf contributors, Apache-2.0"
version = release = installed_version("bathynerf")

# The source folder is the repository's root (see the Makefile), so that links between README.md, CONVENTIONS.md and
# docs/ are the same files here and in a listing of the repository.
root_doc = "docs/index"
include_patterns = ["docs/**", "CONVENTIONS.md", "CONTRIBUTING.md", "CHANGELOG.md"]
exclude_patterns = ["docs/img/**", "docs/sphinx/**"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "help_pages",
]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 4
# Notebooks run when the site is built; a cell that raises fails the build.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 300
autosummary_generate = True
templates_path = [str(_HERE / "templates")]
autodoc_typehints = "none"
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = "bathynerf"
html_theme_options = {
    "header_links_before_dropdown": 6,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
}
html_show_sourcelink = False
