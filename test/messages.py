"""All messages to the user that stand in the source, as templates: … in the place of figures."""
from __future__ import annotations

import ast
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / 'dashcalib_ros'
# shorter texts are parts of messages, names and formats
LEAST_WORDS = 4


def messages_in(path: Path) -> list[str]:
    """Return the templates of all texts of several words in a module, without docstrings."""
    tree = ast.parse(path.read_text('utf-8'))
    inner = {part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)
             for part in ast.walk(node) if part is not node} | docstrings(tree)
    texts = [template(node) for node in ast.walk(tree)
             if isinstance(node, (ast.Constant, ast.JoinedStr)) and node not in inner]
    return [text for text in texts if len(text.replace('…', ' ').split()) >= LEAST_WORDS]


def docstrings(tree: ast.AST) -> set[ast.AST]:
    """Return the nodes of texts that stand alone."""
    return {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}


def template(node: ast.AST) -> str:
    """Return a text with … in the place of what is only known when it is shown."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else ''
    assert isinstance(node, ast.JoinedStr)
    return ''.join(str(part.value) if isinstance(part, ast.Constant) else '…'
                   for part in node.values)
