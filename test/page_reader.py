# SPDX-License-Identifier: Apache-2.0
"""Reads report.html as a test sees it."""
from __future__ import annotations

from html.parser import HTMLParser

VOID = {'meta', 'img', 'br', 'input'}


class Page(HTMLParser):
    """Checks that tags nest, and collects text and addresses."""

    def __init__(self, text):
        super().__init__()
        self.open, self.text, self.links, self.tags = [], '', [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for key, value in attrs if key in ('src', 'href', 'srcset')]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data + ' '
