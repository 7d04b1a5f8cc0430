"""The operators of a module that can be flipped, and the module with one of them flipped."""

import ast
import copy
from collections.abc import Iterator
from typing import NamedTuple

__all__ = ["Flip", "flipped", "flips_of"]

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.MatMult: ast.Mult,
}
_UNARY = (ast.Not, ast.USub)


class Flip(NamedTuple):
    """An operator: its position among the nodes of the module, its line, and the change."""

    position: int
    line: int
    what: str


def flips_of(source: str) -> list[Flip]:
    """Return the operators of a module that can be flipped, in the order of its nodes."""
    nodes = list(_code_nodes(ast.parse(source)))
    return [
        Flip(position, getattr(node, "lineno", 0), what)
        for position, node in enumerate(nodes)
        if (what := _flip(copy.deepcopy(node)))
    ]


def flipped(source: str, flip: Flip) -> ast.Module:
    """Return a module in which one operator is flipped."""
    tree = ast.parse(source)
    _flip(list(_code_nodes(tree))[flip.position])
    return tree


def _code_nodes(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield all nodes except operations by ``|`` and ``&``, many of which are unions of types."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.BitOr | ast.BitAnd):
            yield node


def _flip(node: ast.AST) -> str:
    """Flip an operator in place; return a description of the change, empty if there was none."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in _COMPARISONS:
        old = type(node.ops[0])
        node.ops[0] = _COMPARISONS[old]()
        return f"{old.__name__} to {_COMPARISONS[old].__name__}"
    if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC and not _is_text(node):
        before = type(node.op)
        node.op = _ARITHMETIC[before]()
        return f"{before.__name__} to {_ARITHMETIC[before].__name__}"
    if isinstance(node, ast.BoolOp):
        name = type(node.op).__name__
        node.op = ast.And() if isinstance(node.op, ast.Or) else ast.Or()
        return f"{name} to {type(node.op).__name__}"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, _UNARY):
        name = type(node.op).__name__
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else node.op
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
            ast.fix_missing_locations(node)
        return f"{name} removed"
    return ""


def _is_text(node: ast.BinOp) -> bool:
    """Return whether an operand is a string: formatting is not arithmetic."""
    parts = (node.left, node.right)
    return any(
        isinstance(part, ast.JoinedStr)
        or (isinstance(part, ast.Constant) and isinstance(part.value, str | bytes))
        for part in parts
    )
