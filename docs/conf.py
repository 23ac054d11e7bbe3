"""Settings of Sphinx: `make docs`."""

from importlib import metadata

project = "ReGIL"
release = metadata.version("regil-sb3")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]

myst_heading_anchors = 3
highlight_language = "none"
default_role = "code"  # docstrings write `name`

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 80
napoleon_use_ivar = True

html_theme = "furo"
html_title = f"ReGIL {release}"
html_copy_source = False
