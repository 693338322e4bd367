#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Write docs/messages.md, the table of all messages with a code: python docs/messages.py.

The messages are read from the source, which is not run: every call with a literal code ('E-...')
counts. What is only known at run time is shown as an ellipsis.
"""
from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / 'dashcalib_ros'
PAGE = Path(__file__).with_name('messages.md')
CODE = re.compile(r'E(-[A-Z0-9]+){1,5}')
ROOTS = {'DashcalibError', 'Notice'}
HEAD = """\
# Messages

Every error, every warning, and every reason of a verdict or of a mounting has a code. The code
stays the same when the text is improved: search for the code, and use it in scripts. An ellipsis
stands for a file name, a number or another text that is known at run time only. Written by
`python docs/messages.py`.

| code | message |
|---|---|
"""


def trees(folder: Path = PACKAGE) -> dict[Path, ast.Module]:
    """Return the parsed modules of a package by their paths."""
    return {path: ast.parse(path.read_text('utf-8')) for path in sorted(folder.rglob('*.py'))}


def faults(modules: Mapping[Path, ast.Module]) -> list[str]:
    """Return where an error or a warning is made without a literal code, or that of an error."""
    names = _coded_names(modules.values())
    return [f'{path.name}:{node.lineno}' for path, tree in modules.items()
            for node in ast.walk(tree) if _lacks_code(node, names)]


def messages(modules: Mapping[Path, ast.Module]) -> list[tuple[str, str]]:
    """Return (code, text) of all messages, sorted; a text that is not known is left out."""
    found: dict[str, set[str]] = {}
    for tree in modules.values():
        constants = _constants(tree)
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
            values = [*call.args, *(each.value for each in call.keywords)]
            for code in (each.value for each in values if _is_code(each)):
                found.setdefault(code, set()).update(
                    text for value in values for text in _texts(value, constants) if ' ' in text)
    return [(code, text) for code in sorted(found) for text in sorted(found[code]) or ['…']]


def page(rows: Iterable[tuple[str, str]]) -> str:
    """Return the text of the page."""
    return HEAD + ''.join(f'| `{code}` | {_escaped(text)} |\n' for code, text in rows)


def _is_code(node: ast.AST) -> bool:
    return (isinstance(node, ast.Constant) and isinstance(node.value, str)
            and CODE.fullmatch(node.value) is not None)


def _coded_names(modules: Iterable[ast.Module]) -> set[str]:
    """Return the names of what has a code: the roots and their children."""
    classes = [node for tree in modules for node in ast.walk(tree)
               if isinstance(node, ast.ClassDef)]
    names, size = set(ROOTS), 0
    while len(names) > size:
        size = len(names)
        names |= {each.name for each in classes if names & set(map(_name, each.bases))}
    return names


def _lacks_code(node: ast.AST, names: set[str]) -> bool:
    if isinstance(node, ast.Raise):
        return _name(node.exc) in names
    if not isinstance(node, ast.Call) or _name(node.func) not in names:
        return False
    code = node.args[0] if node.args else None
    return not (_is_code(code) or (isinstance(code, ast.Attribute) and code.attr == 'code'))


def _name(node: ast.AST | None) -> str:
    return getattr(node, 'id', getattr(node, 'attr', ''))


def _constants(tree: ast.Module) -> dict[str, ast.expr]:
    """Return the values of a module's constants, which texts have parts from."""
    return {target.id: node.value for node in tree.body if isinstance(node, ast.Assign)
            for target in node.targets if isinstance(target, ast.Name)}


def _texts(node: ast.expr, constants: Mapping[str, ast.expr]) -> Iterator[str]:
    """Yield the texts that an expression may have, of which there are several with an if."""
    if isinstance(node, ast.IfExp):
        yield from _texts(node.body, constants)
        yield from _texts(node.orelse, constants)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        for start in _texts(node.left, constants):
            yield from (start + end for end in _texts(node.right, constants))
    else:
        yield re.sub('…+', '…', _template(node, constants))


def _template(node: ast.expr, constants: Mapping[str, ast.expr]) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return ''.join(_template(part, constants) for part in node.values)
    if isinstance(node, ast.FormattedValue):
        if isinstance(node.value, ast.Call) and _name(node.value.func) == 'counted':
            return f'… {_template(node.value.args[1], constants)}s'
        value = constants.get(_name(node.value))
        return '…' if value is None else _template(value, constants)
    return '…'


def _escaped(text: str) -> str:
    return re.sub(r'([|<*`])', r'\\\1', ' '.join(text.split()))


if __name__ == '__main__':
    PAGE.write_text(page(messages(trees())), 'utf-8')
