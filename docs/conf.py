"""Sphinx configuration: furo, MyST notebooks, and an API reference taken from the docstrings."""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from jupyter_client.manager import KernelManager
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

import unirender

project = "unirender"
author = "The unirender maintainers"
version = release = unirender.__version__
copyright = f"2026, {author}"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "_*.md", "jupyter_execute", "**.ipynb_checkpoints"]
templates_path = ["_templates"]
html_theme = "furo"
html_title = f"unirender {version}"
html_static_path = ["_static"]
html_css_files = ["narrow.css"]
html_math_renderer = "mathml"

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 240
nb_output_stderr = "remove"
nb_render_markdown_format = "myst"  # tables
# Encrypted sockets: over plain ones ipykernel warns, once for every page that is executed.
KernelManager.transport_encryption.default_value = "auto"

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
default_role = "literal"
# A type in a signature may have the name of something else, too: `object`, a field of commands, is also a type.
suppress_warnings = ["ref.python"]

RESULTS = Path(__file__).parents[1] / "evaluation" / "results"

_CODE = re.compile(r"(``.+?``|`[^`]+`)")
_OVERLINE = re.compile(r'<mover accent="false">((?:(?!<mover).)*?)<mo accent="true">_</mo>\s*</mover>', re.DOTALL)
_COUNT = re.compile(r"\(n = (\d+)\)")
_EMPHASIS = re.compile(r"(?<![\w*])\*(?=[^\s*])([^*]*[^\s*])\*(?![\w*])")


def _escape(text: str) -> str:
    """Escapes what reStructuredText would read as markup in a sentence that is none: `a * b`, `|x|`, `name_`."""
    marked = _EMPHASIS.sub("\0\\1\1", text)
    marked = re.sub(r"([*|])", r"\\\1", marked)
    marked = re.sub(r"(\w)_(?!\w)", r"\1\\_", marked)
    return marked.replace("\0", "*").replace("\1", "*")


def _docstring(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Docstrings here are plain sentences with `code` in backticks and indented formulas: make that safe markup."""
    out: list[str] = []
    sentence: list[str] = []  # lines up to the next formula; code in backticks may run over a line end

    def flush() -> None:
        parts = _CODE.split("\n".join(sentence))
        for i, part in enumerate(parts):
            if i % 2 == 0:
                parts[i] = _escape(part)
            elif not parts[i - 1].endswith(":"):  # no role in front: code, with or without a letter behind ("`Array`s")
                parts[i] = f"``{part.strip('`')}``" + ("\\ " if parts[i + 1][:1].isalnum() else "")
        out.extend("".join(parts).split("\n"))
        sentence.clear()

    formula = False
    for line in lines:
        indented = line.startswith("    ") and bool(line.strip())
        in_list = any(previous.startswith("- ") for previous in sentence[-3:])
        if formula and line.strip() and not indented:
            formula = False
        elif what == "module" and indented and not formula and not in_list and sentence and not sentence[-1].strip():
            flush()
            out += ["::", ""]
            formula = True
        if formula:
            out.append(line)
        else:
            sentence.append(line)
    flush()
    lines[:] = out


def _results(app: Sphinx, docname: str, source: list[str]) -> None:
    """Puts the committed result tables of each suite where the results page names it."""
    if docname == "results":
        source[0] = re.sub(r"<!-- tables: ([\w-]+) -->", lambda found: _tables(RESULTS / found[1]), source[0])


def _tables(folder: Path) -> str:
    return "\n\n".join(path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.md")))


def _exact_types(app: Sphinx, doctree: nodes.document) -> None:
    """Sphinx looks through all that is documented for each type of a signature that is not among it, and finds a field
    named `object`. A whole name or a built-in needs no search; a bare class is one that is imported for checks.
    """
    for reference in doctree.findall(addnodes.pending_xref):
        name = reference["reftarget"]
        if reference.get("refspecific") is False and ("." in name or name.islower()):
            del reference["refspecific"]


def _intervals(app: Sphinx, doctree: nodes.document) -> None:
    """Half an interval stays on one line with its sign, and a row's count with its `n`: a column may be narrower."""
    for text in list(doctree.findall(nodes.Text)):
        kept = _COUNT.sub("(n\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}\\1)", text.replace("± ", "±\N{NO-BREAK SPACE}"))
        if kept != text and not isinstance(text.parent, (nodes.literal, nodes.literal_block)):
            text.parent.replace(text, nodes.Text(kept))


def _formulas(app: Sphinx, doctree: nodes.document) -> None:
    """Each formula becomes MathML, which browsers draw by themselves: MathJax would be fetched from another host."""
    for formula in doctree.findall(lambda node: isinstance(node, (nodes.math, nodes.math_block))):
        block = isinstance(formula, nodes.math_block)
        try:
            markup = tex2mathml(formula.astext().strip(), as_block=block)
        except MathError as error:
            logging.getLogger(__name__).warning("formula %r: %s", formula.astext(), error, location=formula)
            markup = ""
        markup = _OVERLINE.sub(r'<mrow class="overline">\1</mrow>', markup)  # no browser stretches docutils' bar
        formula["mathml"] = f'<div class="math">{markup}</div>' if block else markup


def _mathml(writer: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    writer.body.append(node["mathml"])
    raise nodes.SkipNode


def _short_navigation(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: nodes.document) -> None:
    """The sidebar opens the branch that one is in. All of the API reference on each of its 490 pages took minutes."""
    if "toctree" in context:
        whole = context["toctree"]
        context["toctree"] = lambda **options: whole(**options | {"collapse": True})


def setup(app: Sphinx) -> None:
    app.add_html_math_renderer("mathml", inline_renderers=(_mathml, None), block_renderers=(_mathml, None))
    app.connect("source-read", _results)
    app.connect("doctree-read", _formulas, priority=100)  # before headings are copied
    app.connect("doctree-read", _exact_types)
    app.connect("doctree-read", _intervals)
    app.connect("autodoc-process-docstring", _docstring, priority=100)
    app.connect("html-page-context", _short_navigation, priority=400)  # before the theme draws it
