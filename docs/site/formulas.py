"""A Sphinx extension: formulas as drawings inside the page, made by matplotlib.

Sphinx's own way loads a script from the web when a page is read, and browsers draw formulas well
only with fonts that few systems have. These drawings look the same everywhere, also where there
is no web. A screen reader reads the source.
"""

from html import escape
from typing import Any

import numpy as np
from docutils import nodes
from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import MathTextParser
from matplotlib.path import Path
from matplotlib.textpath import TextPath
from sphinx.application import Sphinx

SIZE = 100  # units of a drawing per em
COMMANDS = {Path.MOVETO: "M", Path.LINETO: "L", Path.CURVE3: "Q", Path.CURVE4: "C"}
FONTS = FontProperties(math_fontfamily="stix", size=SIZE)


def svg(formula: str, kind: str) -> str:
    """Return a formula as an SVG element that stands on the line of the text around it."""
    source = f"${' '.join(formula.split())}$"
    box = MathTextParser("path").parse(source, dpi=72, prop=FONTS)
    drawn = TextPath((0, 0), source, prop=FONTS)
    width, height, depth = box[0], box[1], box[2]
    points = "".join(
        _step(code, values) for values, code in drawn.iter_segments(simplify=False, curves=True)
    )
    frame = f"-2 {-(height - depth) - 4:.0f} {width + 4:.0f} {height + 8:.0f}"
    em = f"width:{width / SIZE:.3f}em;height:{(height + 8) / SIZE:.3f}em"
    return (
        f'<svg class="formula {kind}" role="img" aria-label="{escape(formula.strip())}" '
        f'viewBox="{frame}" style="{em};vertical-align:{-(depth + 4) / SIZE:.3f}em">'
        f'<path fill="currentColor" d="{points}"/></svg>'
    )


def _step(code: int, values: Any) -> str:
    if code not in COMMANDS:
        return "Z"
    down = values * np.tile([1, -1], len(values) // 2)
    return COMMANDS[code] + " ".join(f"{v:.0f}" for v in down)


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(svg(node.astext(), "inline"))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    drawn = svg(node.astext().replace(r"\frac", r"\dfrac"), "display")
    translator.body.append(f'<div class="formula">{drawn}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer under the name that `html_math_renderer` chooses."""
    app.add_html_math_renderer("drawn", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
