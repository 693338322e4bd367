# SPDX-License-Identifier: Apache-2.0
"""Pages in a real browser, where there is one: what is cut, over other text, or fails."""
from __future__ import annotations

import html
import json
import re
import shutil
import subprocess

BROWSER = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which(
    'google-chrome')
# puts what it finds into the page's title
CHECK = r"""<script>
const errors = [];
for (const kind of ['error', 'warn']) console[kind] = text => errors.push(String(text));
addEventListener('error', event => errors.push(event.message));
addEventListener('load', () => {
  const boxes = [...document.querySelectorAll('svg text')].map(text =>
    [text.textContent, text.getBoundingClientRect(), text.closest('svg')]);
  const overlaps = [];
  boxes.forEach(([a, p, own], n) => boxes.slice(n + 1).forEach(([b, q, other]) => {
    // boxes have a little room above and below the letters
    if (own === other && p.left < q.right && q.left < p.right
        && p.top + 2 < q.bottom && q.top + 2 < p.bottom) overlaps.push([a, b]);
  }));
  const outside = boxes.filter(([text, box, own]) => {
    const whole = own.getBoundingClientRect();
    return box.left < whole.left - 1 || box.right > whole.right + 1
      || box.top < whole.top - 1 || box.bottom > whole.bottom + 1;
  }).map(([text]) => text);
  // the drive's plot and a fleet's tables may be scrolled on a phone
  const cut = [...document.querySelectorAll('body *:not(svg *, .wide, .spoken)')].filter(box =>
    box.scrollWidth > box.clientWidth + 1 && getComputedStyle(box).display !== 'inline'
    && box.clientWidth).map(box => [box.tagName, box.textContent.trim().slice(0, 60)]);
  const copied = [];
  navigator.clipboard.writeText = async text => copied.push(text);
  document.querySelectorAll('button').forEach(button => button.click());
  const uncopied = [...document.querySelectorAll('pre')].map(block => block.textContent)
    .filter((text, n) => text !== copied[n]);
  const views = [...document.querySelectorAll('.space')];
  const drawn = () => [...document.querySelectorAll('.space path')]
    .flatMap(path => path.getAttribute('d').match(/-?[\d.]+/g).map(Number));
  const moved_by = (...keys) => {
    const before = drawn();
    for (const key of keys) for (const view of views)
      view.dispatchEvent(new KeyboardEvent('keydown', {key}));
    return Math.max(0, ...drawn().map((value, n) => Math.abs(value - before[n])));
  };
  // the script draws what was drawn before it
  const redrawn_px = Math.floor(moved_by('ArrowUp', 'ArrowDown') / 0.3);
  const unmoved = views.length && moved_by('ArrowLeft') < 5;
  document.title = JSON.stringify({errors, overlaps, outside, cut, uncopied, redrawn_px, unmoved,
    texts: boxes.length, copied: copied.length,
    wide: document.documentElement.scrollWidth - document.documentElement.clientWidth});
});
</script>"""


def found_by_the_browser(folder, text, width):
    """Return what CHECK finds in a page that is so many px wide."""
    (folder / 'page.html').write_text(text.replace('<head>', '<head>' + CHECK))
    # a window cannot be as narrow as a phone, a frame can
    (folder / 'frame.html').write_text(
        f'<iframe id="f" src="page.html" style="width:{width}px;height:900px;border:0"></iframe>'
        '<script>f.onload = () => setTimeout(() => {'
        'document.body.append("FOUND" + f.contentDocument.title + "END")})</script>')
    run = subprocess.run(
        [BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--no-first-run',
         '--disable-background-networking', '--disable-component-update', '--disable-sync',
         '--allow-file-access-from-files', f'--user-data-dir={folder / "profile"}',
         '--window-size=1300,900', '--virtual-time-budget=4000', '--enable-logging=stderr',
         '--dump-dom', (folder / 'frame.html').as_uri()],
        capture_output=True, text=True, timeout=120, check=True)
    # what the parser of SVG says, too
    console = re.findall(r'CONSOLE.*', run.stderr)
    found = html.unescape(re.findall(r'FOUND({.*?})END', run.stdout)[-1])
    return {**json.loads(found), 'console': console}
