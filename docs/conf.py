# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The documentation as a site: `make study NAME=docs` builds it with Sphinx, and every warning is an error.

The pages are the Markdown files that a git host shows too. The whole repository is Sphinx's source folder, so that
their links to README.md, config/ and examples/ hold in both places. Formulas become MathML, which browsers show without
a script: nothing is loaded from the internet.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # autodoc imports the core of this tree, not an installed one

project = "exo_gravity"
author = "exo_gravity maintainers"
release = version = ElementTree.parse(ROOT / "package.xml").findtext("version", "")

extensions = ["myst_parser", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
include_patterns = ["docs/*.md", "README.md", "CONTRIBUTING.md", "CHANGELOG.rst", "test/data/*/*.md"]
default_role = "code"  # what docstrings put in single backticks
root_doc = "docs/index"

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"exo_gravity {version}"
html_extra_path = ["_static/index.html"]  # from the site's top to docs/index.html
html_math_renderer = "mathml"
html_show_sphinx = False
html_show_copyright = False
pygments_style = "friendly"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4  # GitHub's anchors
suppress_warnings = ["myst.header"]  # README begins with level 1, as it must; some tables' documents skip a level

autodoc_typehints = "signature"
autodoc_member_order = "bysource"


def show_inline(translator: Any, node: nodes.math) -> None:
    """Write a formula within a sentence."""
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def show_block(translator: Any, node: nodes.math_block) -> None:
    """Write a display formula."""
    translator.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>\n')
    raise nodes.SkipNode


def leave_folders_as_text(app: Sphinx, document: nodes.document) -> None:
    """Turn links to folders of the repository, which the site does not contain, into plain text."""
    for link in list(document.findall(pending_xref)):
        page = Path(app.srcdir, link.get("refdoc", ""))
        if link.get("reftype") == "myst" and (page.parent / link["reftarget"]).is_dir():
            link.replace_self(link.children)


def setup(app: Sphinx) -> None:
    """Register what this site adds to Sphinx."""
    app.add_html_math_renderer("mathml", (show_inline, None), (show_block, None))
    app.connect("doctree-read", leave_folders_as_text)
