# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""HTML pages that need nothing outside themselves, and the look of their figures.

A function that returns a piece of HTML escapes every text that it is given; a line break in a heading is kept. The
palette is that of Okabe and Ito (2008), whose colours can be distinguished with any colour vision.
"""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.numbers import one_float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
INCH, WIDTHS = 25.4, (40.0, 400.0)  # mm; of a printed figure
PRINTED, PAGE = 8.0, 230.0  # points of its letters, and mm of height at most
ROW, LINE, ENTRY = 36.0, 4.5, 38.0  # mm: height of axes and of a line of the legend, width of a name in that
JOINT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
MORE_COLOURS = ("#E69F00", "#56B4E9", "#882255", "#44AA99", "#999933")  # of arms with more joints
INK, FAINT, GRID_LINE = "#222222", "#9AA3AB", "#D5DADF"
HOLD_COLOUR, PUSH_COLOUR = "#E8EEF4", "#F9E3B4"

STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 72rem; margin: 2rem auto;
       padding: 0 1rem; }
h1 { margin: 0; font-size: 1.8rem; } h2 { margin: 2.5rem 0 .5rem; } h3 { margin: 1.5rem 0 .3rem; font-size: 1.05rem; }
.when, footer { color: #5a646d; } figure { margin: 1rem 0; } img { width: 100%; height: auto; }
figcaption { color: #5a646d; font-size: .9rem; }
.verdict { border-left: .4rem solid #009E73; background: #eef7f3; padding: .7rem 1rem; margin: 1.2rem 0; }
.verdict.not { border-color: #D55E00; background: #fdf1ea; }
.source { display: inline-block; border: 2px dashed #5a646d; padding: .2rem .8rem; margin: .8rem 0 0;
          font-weight: 700; }
.verdict ul { margin: .3rem 0 0; padding-left: 1.2rem; }
figure, .scroll { overflow-x: auto; }
.scroll { background: linear-gradient(to right, #fff 30%, transparent) local,
          linear-gradient(to left, #fff 30%, transparent) right local,
          linear-gradient(to right, #0003, transparent) left scroll,
          linear-gradient(to left, #0003, transparent) right scroll; background-repeat: no-repeat;
          background-size: 3rem 100%, 3rem 100%, .7rem 100%, .7rem 100%; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .15rem .6rem; text-align: right; white-space: nowrap; }
th { font-weight: 600; vertical-align: bottom; }
thead { border-bottom: 2px solid #9aa3ab; } tbody { border-bottom: 1px solid #d5dadf; }
tbody th { font-weight: inherit; text-align: left; }
.joints th::before { content: "●"; margin-right: .4rem; }
pre { background: #f4f6f8; padding: .7rem 1rem; overflow-x: auto; font-size: .85rem; }
@media screen and (max-width: 40rem) {
  body { margin: 1rem auto; } h1 { font-size: 1.5rem; } figure img { width: 48rem; }
  table { font-size: .82rem; } th, td { padding-inline: .35rem; }
}
""" + "\n".join(
    f".joints tr:nth-child({n}) th::before {{ color: {c}; }}" for n, c in enumerate(JOINT_COLOURS + MORE_COLOURS, 1)
)


def joint_colours(count: int) -> tuple[str, ...]:
    """Return a colour for each of `count` joints."""
    return tuple(islice(cycle(JOINT_COLOURS + MORE_COLOURS), count))


def document(title: str, when: str, body: Iterable[str]) -> str:
    """Return a page; when: the line below the title. body: pieces of HTML."""
    content = "\n".join(body)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
        f'<style>{STYLE}</style></head><body><main>\n<h1>{escape(title)}</h1><p class="when">{escape(when)}</p>\n'
        f"{content}</main></body></html>\n"
    )


def verdict(sentence: str, reasons: Iterable[str] = (), good: bool = True) -> str:
    """Return a banner with the conclusion, and the reasons for it."""
    return f'<div class="verdict{"" if good else " not"}"><b>{escape(sentence)}</b>{_items(reasons)}</div>'


def heading(text: str, level: int = 3) -> str:
    """Return a heading of a section (2) or of a part of one (3)."""
    return f"<h{level}>{escape(text)}</h{level}>"


def bullets(title: str, lines: Iterable[str]) -> str:
    """Return a heading and a list, or '' if there are no lines."""
    return (items := _items(lines)) and (heading(title) if title else "") + items


def make_plain(axis: "Axes") -> None:
    """Leave two spines of a figure's axes, and faint horizontal lines."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.spines[["left", "bottom"]].set_color(FAINT)
    axis.tick_params(color=FAINT, labelcolor=INK, labelsize=9)
    axis.grid(axis="y", color=GRID_LINE, lw=0.5)
    axis.set_axisbelow(True)


def png_of(figure: "Figure", dpi: int = DPI) -> bytes:
    """Return a figure as PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


@dataclass(frozen=True)
class Print:
    """How figures are written for a paper, at the size at which they are printed. Raises ParameterError."""

    formats: Sequence[str] = ()  #: 'pdf' or 'svg'
    width: float = 170.0  #: mm
    font: str = "DejaVu Sans"

    def __post_init__(self) -> None:
        one_float("width", self.width, *WIDTHS, "mm")
        if self.formats:
            from matplotlib.font_manager import findfont

            try:
                findfont(self.font, fallback_to_default=False)
            except ValueError:
                raise ParameterError("font", self.font, "the name of a font that is installed here") from None

    def fit(self, figure: "Figure") -> None:
        """Give a figure of the page its printed size and letters."""
        from matplotlib.lines import Line2D
        from matplotlib.text import Text

        width, height = figure.get_size_inches()
        tall = max(height / width * self.width, min(PAGE, ROW * len(figure.axes)))
        parts: list[Any] = [figure, *figure.axes]
        for part in parts:
            for legend in part.legends if part is figure else filter(None, [part.get_legend()]):
                handles, names = legend.legend_handles, [text.get_text() for text in legend.get_texts()]
                legend.remove()
                columns = max(1, min(len(names), int(self.width / ENTRY)))
                where = "outside upper center" if part is figure else "lower left"
                anchor = None if part is figure else (0.0, 1.0)
                part.legend(handles, names, loc=where, bbox_to_anchor=anchor, ncols=columns, frameon=False)
                tall += LINE * -(-len(names) // columns)
        figure.set_size_inches(self.width / INCH, tall / INCH)
        for text in figure.findobj(Text):
            text.set(fontsize=PRINTED, fontfamily=self.font)
        for axis in figure.axes:
            axis.tick_params(labelsize=PRINTED, labelfontfamily=self.font)
        for line in figure.findobj(Line2D):
            line.set_linewidth(0.75 * line.get_linewidth())


def saved(figure: "Figure", path: Path, stamp: str, on_paper: Print) -> bytes:
    """Write a figure to the PNG `path`, and in the formats for print next to it; return the PNG.

    stamp: at the lower right, which a picture that is copied elsewhere keeps.
    """
    import matplotlib

    figure.text(0.995, 0.004, stamp, ha="right", va="bottom", color=INK, fontsize=9, weight="bold")
    path.write_bytes(png := png_of(figure))
    if on_paper.formats:
        on_paper.fit(figure)
    with matplotlib.rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):  # journals accept no Type 3
        for suffix in on_paper.formats:
            figure.savefig(path.with_suffix(f".{suffix}"))
            if suffix == "svg":
                _embed(path.with_suffix(".svg"), on_paper.font)
    return png


def _embed(svg: Path, font: str) -> None:
    """Embed in an SVG the letters of the font that it uses."""
    from fontTools import subset
    from matplotlib.font_manager import findfont

    text, options = svg.read_text(encoding="utf-8"), subset.Options(flavor="woff")
    options.drop_tables += ["FFTM"]  # the date of FontForge, of which fontTools would warn
    face, buffer = subset.load_font(findfont(font), options), BytesIO()
    chooser = subset.Subsetter(options)
    chooser.populate(text=text)
    chooser.subset(face)
    subset.save_font(face, buffer, options)
    data = base64.b64encode(buffer.getvalue()).decode()
    style = f"<style>@font-face {{ font-family: '{font}'; src: url(data:font/woff;base64,{data}); }}</style>"
    svg.write_text(text.replace("<defs>", f"<defs>{style}", 1), encoding="utf-8")


def picture(png: bytes, caption: str) -> str:
    """Return an embedded PNG with its caption, which is also its text for screen readers."""
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return f'<figure><img alt="{escape(caption)}" src="{source}"><figcaption>{escape(caption)}</figcaption></figure>'


def table(heads: Sequence[str], groups: Iterable[tuple[Sequence[str], Iterable[Sequence[str]]]], kind: str = "") -> str:
    """Return a table of groups: the cells that the rows of a group share, which come first, and the rows.

    The first cell of a row is its heading. kind: 'joints', if the rows of each group are those of the joints.
    """
    head = "".join(f'<th scope="col">{_text(text)}</th>' if text else "<td></td>" for text in heads)
    body = ""
    for shared, rows in groups:
        lines = [f'<th scope="row">{_text(first)}</th>{_cells(rest)}' for first, *rest in rows]
        lines[0] = _cells(shared, f' rowspan="{len(lines)}"') + lines[0]
        body += f'<tbody class="{kind}"><tr>{"</tr><tr>".join(lines)}</tr></tbody>'
    return f'<div class="scroll" tabindex="0"><table><thead><tr>{head}</tr></thead>{body}</table></div>'


def _cells(cells: Iterable[str], span: str = "") -> str:
    return "".join(f"<td{span}>{_text(cell)}</td>" for cell in cells)


def _text(text: str) -> str:
    return escape(text).replace("\n", "<br>")


def _items(lines: Iterable[str]) -> str:
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""
