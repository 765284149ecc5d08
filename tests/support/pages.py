"""What tests look at in a page of the report."""

from __future__ import annotations

from html.parser import HTMLParser

WIDE, NARROW = 1280, 390
# Elements that stick out, or that scroll within themselves.
STICKING_OUT = """[...document.querySelectorAll('main *')].filter(e => {
  const box = e.getBoundingClientRect();
  return box.width && (box.right > innerWidth + 1 || box.left < -1);
}).map(e => e.tagName + '.' + e.className)"""
SCROLLING = """[...document.querySelectorAll('main *')].filter(e =>
  e.scrollWidth > e.clientWidth + 1 && ['auto', 'scroll'].includes(getComputedStyle(e).overflowX)
).map(e => e.tagName + '.' + e.className)"""


class Links(HTMLParser):
    """Everything the page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.scripts = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        for name, value in attrs:
            if (
                (name in {"src", "poster", "href"} or (name.startswith("data-") and tag == "video"))
                and value
                and "/" in value
            ):
                self.found.append(value)
