"""The site: Sphinx reads the pages, executes the tutorials and asks the package for the reference.

Sphinx with MyST, because the pages are Markdown that also reads well where the repository is
looked at, notebooks are pages like others, and the reference is made of the package's docstrings.
"""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import crane  # noqa: E402

project = "crane"
author = copyright = "The crane authors"
version = release = crane.__version__
language = "en"
highlight_language = "none"  # of equations in docstrings
smartquotes = False  # they make a dash of the two before an option
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # equations are drawn without a network, too
    "sphinx_copybutton",
    "sphinx_design",
    "reference",
    "gallery",
]
exclude_patterns = ["README.md"]

myst_enable_extensions = ["amsmath", "colon_fence", "dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "force"  # what is kept of notebooks does not know that the package has changed
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_execution_in_temp = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say shapes and units, which types do not
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
napoleon_use_rtype = False
default_role = "public"  # `name` in a docstring: a link if it is one of the package's

html_theme = "furo"
html_title = f"crane {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["generated/pages"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
