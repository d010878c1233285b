"""Settings of the site that `make docs-site` builds from docs/."""

import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from pages import DATA, not_run, on_source

from fes import __version__

os.environ["FES_DATA"] = str(DATA)  # the notebooks that run look for their recordings there
project, author, release = "fes", "the authors of fes", __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["*.py", "site/*.py", "site/requirements.in"]
html_theme, html_title, html_show_sourcelink = "furo", f"fes {release}", False
suppress_warnings = ["myst.header"]  # a page may begin with its third level of headings
myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
nb_custom_formats = {".py": ["pages.read_notebook", {}]}
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).resolve().parents[2] / "out" / "site-notebooks")
nb_execution_excludepatterns = not_run()
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_show_tb = True
autodoc_member_order, autodoc_typehints, autodoc_preserve_defaults = "bysource", "description", True
napoleon_google_docstring, napoleon_numpy_docstring, napoleon_use_ivar = True, False, True


def setup(app):
    app.connect("source-read", on_source)
