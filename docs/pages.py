# SPDX-License-Identifier: Apache-2.0
"""Hooks of mkdocs.yml: the site has the repository's tree, so that every link is right in both."""
from __future__ import annotations

import html
import re
import subprocess
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import dashcalib_ros

ROOT = Path(__file__).parents[1]
# `dashcalib demo` writes it; without it the site has no page of a report
REPORT = 'demo/report.html'
# what documents link to as files
LINKED = ('config/', 'examples/', 'Dockerfile', 'CITATION.cff', 'package.xml',
          'dashcalib_ros/limits.py')


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the report of a demo drive, where there is one."""
    if (ROOT / REPORT).exists():
        config.nav.append({'A report': REPORT})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Return the documents and what they link to, and the page of the Python interface."""
    tracked = subprocess.run(['git', 'ls-files', '--cached', '--others', '--exclude-standard'],
                             cwd=ROOT, check=True, capture_output=True, text=True).stdout
    names = [name for name in tracked.splitlines() if name.startswith(LINKED)
             or (name.endswith(('.md', '.svg', '.png', '.json')) and not name.startswith('.'))]
    if (ROOT / REPORT).exists():
        names.append(REPORT)
    api = ['# Python', *(f'::: dashcalib_ros.{name}' for name in dashcalib_ros.__all__
                         if name != '__version__')]
    # the theme's own
    others = [file for file in files if file.src_dir != config.docs_dir]
    return Files([*others,
                  *(File(name, str(ROOT), config.site_dir, config.use_directory_urls)
                    for name in names if (ROOT / name).is_file()),
                  File.generated(config, 'docs/api.md', content='\n\n'.join(api) + '\n')])


def on_page_content(text: str, **_: Any) -> str:
    """Return a page with its formulas in MathML: browsers show it without a script."""
    def formula(found: re.Match[str]) -> str:
        display = 'block' if found['opening'] == '[' else 'inline'
        return convert(html.unescape(found['latex']), display=display)
    return re.sub(r'<(?P<tag>\w+) class="arithmatex">\\(?P<opening>[(\[])(?P<latex>.*?)\\[)\]]'
                  r'</(?P=tag)>', formula, text, flags=re.DOTALL)
