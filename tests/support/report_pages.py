"""What a report's page says."""

import base64
import gzip
import re
from html.parser import HTMLParser

from pace_optim.report import write_report

NASTY = "</script><script>alert(1)</script> & <img src=x onerror=alert(2)>"


class Page(HTMLParser):
    """What a page says and what it would load."""

    VOID = ("meta", "link", "br", "input", "img")

    def __init__(self, text: str):
        super().__init__()
        self.texts: list[str] = []
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.ids: list[str] = []
        self._open: list[str] = []
        self.unbalanced: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in self.VOID:
            self._open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "srcset", "data", "poster") or (name == "href" and tag == "link"):
                self.loads.append(value)
            if name == "style":
                self.loads += re.findall(r"url\(([^)]*)\)", value)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        if not self._open or self._open.pop() != tag:
            self.unbalanced.append(tag)

    def handle_data(self, data):
        if self._open and self._open[-1] == "style":
            self.loads += re.findall(r"url\(([^)]*)\)|@import\s+(\S+)", data)
        elif not self._open or self._open[-1] != "script":
            self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())


def page_of(folder) -> Page:
    return Page(write_report(folder).read_text("utf-8"))


def contents_of(page: str) -> str:
    """The data of a page's scripts, unpacked."""
    packed = re.findall(r'data-packed="application/json">([^<]*)<', page)
    return "\n".join(gzip.decompress(base64.b64decode(each)).decode() for each in packed)
