"""A report as one HTML file, which shows everything without a network.

Texts come from run folders, which may be somebody else's: the template escapes all of them, the
pictures are drawn here, and the browser is told to run the one script of this file only.
"""

import base64
import hashlib
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from coil_rl.report.table import Table

# Of the files of pictures that a page may hold, by their kind.
BEGINNINGS = {"png": rb"\x89PNG\r\n\x1a\n", "webp": rb"RIFF....WEBP", "gif": rb"GIF89a"}
SCRIPT = """
for (const button of document.querySelectorAll("th button")) {
  button.addEventListener("click", () => {
    const heading = button.parentElement, column = heading.cellIndex;
    const body = heading.closest("table").tBodies[0];
    const falls = heading.getAttribute("aria-sort") === "descending";
    for (const other of heading.parentElement.cells) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", falls ? "ascending" : "descending");
    const key = row => row.cells[column].dataset.number;
    const text = row => row.cells[column].textContent;
    const rows = [...body.rows].sort((one, other) => {
      const known = [one, other].filter(row => key(row) !== undefined);
      if (known.length === 1) return known[0] === one ? -1 : 1;
      const order = known.length ? key(one) - key(other) : text(one).localeCompare(text(other));
      return falls ? order : -order;
    });
    body.append(...rows);
  });
}
"""


@dataclass(frozen=True)
class Figure:
    """A picture of a report.

    Args:
        title: above it.
        image: an SVG for the page itself, from `svg`, or a `data:` address, from `embedded`.
        caption: below it.
    """

    title: str
    image: Markup | str
    caption: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Args:
        heading: of the part; empty for none.
        blocks: tables and paragraphs.
        figures: pictures below them.
    """

    heading: str
    blocks: Sequence[Table | str]
    figures: Sequence[Figure] = ()


def html_page(title: str, sections: Sequence[Section]) -> str:
    """Return a report as HTML."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    text = (resources.files("coil_rl.report") / "page.html").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(SCRIPT.encode()).digest()).decode()
    return environment.from_string(text).render(
        title=title,
        sections=sections,
        script=Markup(SCRIPT),
        digest=digest,
    )


def svg(draw: Callable[[io.BytesIO], None]) -> Markup:
    """Return a picture of matplotlib as an element of an HTML page.

    Args:
        draw: draws it into a buffer, as the functions of this package do.
    """
    buffer = io.BytesIO()
    draw(buffer)
    text = buffer.getvalue().decode()
    text = text[text.index("<svg") :]
    # In HTML neither the name spaces nor the identifiers of groups are needed, and both cost much.
    text = re.sub(r' xmlns(:xlink)?="[^"]*"', "", text, count=2).replace("xlink:href", "href")
    text = re.sub(r'<g id="[A-Za-z]+_\d+(\.\w+)?">', "<g>", text)
    return Markup(text)


def embedded(content: bytes) -> str:
    """Return a picture as a `data:` address.

    Raises:
        ValueError: for anything but a PNG, WebP or GIF picture.
    """
    for kind, beginning in BEGINNINGS.items():
        if re.match(beginning, content, re.DOTALL):
            return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
    raise ValueError("no PNG, WebP or GIF picture")
