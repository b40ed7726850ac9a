"""How long the docs are: `python docs/words.py`.

Words are those of letters outside of code, in tables too, of all pages but those that are made of
something else: API, configuration, and the pages of the guide benchmark's tasks.
"""

import re
from pathlib import Path

DOCS = Path(__file__).parent
MADE = ("api.md", "configuration.md")


def text_of(page: Path) -> str:
    """Return the text of a page without blocks of code, code in its lines, and links."""
    text = re.sub(r"^```.*?^```|^    .*?$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]*`|\]\([^)]*\)", " ", text)


def words(text: str) -> int:
    """Return the number of words."""
    return len(re.findall(r"[A-Za-z][A-Za-z'-]+", text))


def main() -> None:
    """Print pages, words, and the mean length of a sentence outside of tables."""
    pages = [page for page in DOCS.rglob("*.md") if page.name not in MADE]
    texts = [text_of(page) for page in pages if page.parent.name != "guide_benchmark"]
    prose = "\n".join(
        line for text in texts for line in text.splitlines() if not line.startswith(("|", "#"))
    )
    sentences = [words(each) for each in re.split(r"[.!?]\s|\n\s*\n|\n- ", prose)]
    lengths = [length for length in sentences if length > 2]
    shares = f"{sum(map(words, texts)):,} words, {words(prose):,} of them not in tables"
    print(f"{len(texts)} pages, {shares}; {sum(lengths) / len(lengths):.1f} words a sentence")


if __name__ == "__main__":
    main()
