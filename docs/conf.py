"""How the documentation is built: `make docs`."""

import logging
import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))  # for the extension below
logging.getLogger("calgraph").setLevel(logging.WARNING)  # the gallery logs everything otherwise

project = "calgraph"
author = "the calgraph developers"
project_copyright = "the calgraph developers; Apache-2.0"
version = release = version_of("calgraph")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "site_extension",
]
exclude_patterns = ["_build", "gallery/**/*.ipynb", "gallery/**/*.py", "gallery/**/*.json", "gallery/**/*.zip"]

# Pages are read on the forge as they are, too: its slugs for headings, its dollars for formulas.
myst_enable_extensions = ["dollarmath", "attrs_block"]
myst_heading_anchors = 3

# The gallery warns of spaces anywhere in the path of an example. Its links are relative to docs/, so only names of
# examples matter: the checkout may lie in a folder with a space.
suppress_warnings = ["sphinx_gallery.space_in_filename"]

html_theme = "furo"
html_title = "calgraph"
html_static_path = ["_static"]
templates_path = ["_templates"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_math_renderer = "mathml"

autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autosummary_generate = True
autosummary_ignore_module_all = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
napoleon_google_docstring = True
napoleon_use_rtype = False

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"\.py$",
    "within_subsection_order": "ExampleTitleSortKey",
    "image_scrapers": ("site_extension.figure_scraper",),
    "reset_modules": (),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "capture_repr": (),
    "min_reported_time": 1000,
}
