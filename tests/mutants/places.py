"""The places of a source file where a small mistake could be made, and the mistakes themselves.

`mistakes(path, text)` lists every change as an `Edit`: the characters to replace and their
replacement. A kind of change is one rule in `_changes`. Never changed are docstrings and other
strings, annotations, imports, decorators, assertions and what an error message is made of.
"""

import ast
import re
from collections.abc import Iterator
from typing import NamedTuple


class Edit(NamedTuple):
    """One deliberate mistake."""

    path: str
    line: int
    kind: str
    start: int
    """First character of the text that is replaced."""
    end: int
    new: str
    before: str
    """The changed lines without their indentation, as they were."""
    after: str
    nth: int = 0
    """How many edits of the file before this one look the same."""

    @property
    def name(self) -> str:
        """The same after edits elsewhere in the file: no line number."""
        return f"{self.path} | {self.before} | {self.after} | {self.nth}"


SWAPPED = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "//",
    ast.BitAnd: "|", ast.BitOr: "&", ast.LShift: ">>", ast.RShift: "<<",
}  # fmt: skip
SIGNS = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%",
    ast.BitAnd: "&", ast.BitOr: "|", ast.LShift: "<<", ast.RShift: ">>",
}  # fmt: skip
NEGATED = {
    ast.Lt: ("<", ">="), ast.LtE: ("<=", ">"), ast.Gt: (">", "<="), ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
}  # fmt: skip
STRICTNESS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
OPPOSITE = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "argmin": "argmax",
    "argmax": "argmin", "any": "all", "all": "any", "floor": "ceil", "zeros": "ones",
}  # fmt: skip
KEPT_CALLS = {
    "len", "int", "float", "bool", "str", "list", "tuple", "set", "dict", "range", "enumerate",
    "sorted", "iter", "next", "repr", "print", "sum", "min", "max", "any", "all", "isinstance",
    "asarray", "tree_leaves", "TypeVar", "super", "field", "get_args", "NamedTuple",
}  # fmt: skip
"""Calls of one argument that are not steps: without them the program would hardly run."""
UNORDERED = {"minimum", "maximum", "full", "map", "scan", "pad", "arange", "repeat", "asarray"}
"""Calls of two arguments where changing places changes nothing, or is never meant."""
GUARD = 1e-5
"""Smaller numbers only keep a division or a root defined: twice as much shows nowhere, so they
become a million times as much."""


def mistakes(path: str, text: str) -> list[Edit]:
    """All edits of a file, in order of their places."""
    source, seen, found = _Source(text), {}, []
    for node in _eligible(ast.parse(text)):
        for kind, (start, end), new in _changes(node, source):
            changed = text[:start] + new + text[end:]
            before, after = source.lines_of(start, end), _lines(changed, start, start + len(new))
            look = (before, after)
            seen[look] = seen.get(look, -1) + 1
            line = text.count("\n", 0, start) + 1
            found.append(Edit(path, line, kind, start, end, new, before, after, seen[look]))
    return sorted(found, key=lambda e: (e.start, e.end, e.kind, e.new))


def code(text: str) -> str:
    """A file without its comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [s for s in body if not _is_docstring(s)] or [ast.Pass()]  # type: ignore[attr-defined]
    return ast.unparse(tree)


class _Source:
    """Text with the character positions of its syntax tree's nodes."""

    def __init__(self, text: str) -> None:
        self.text, self.starts = text, [0]
        for line in text.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))

    def _at(self, line: int, column: int) -> int:
        start = self.starts[line - 1]
        return start + len(self.text[start:].encode()[:column].decode())

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        return (
            self._at(node.lineno, node.col_offset),
            self._at(node.end_lineno or 0, node.end_col_offset or 0),
        )

    def of(self, node: ast.expr | ast.stmt) -> str:
        start, end = self.span(node)
        return self.text[start:end]

    def between(self, left: ast.expr, right: ast.expr, sign: str) -> tuple[int, int]:
        """Where `sign` stands between two operands."""
        start = self.text.index(sign, self.span(left)[1], self.span(right)[0])
        return start, start + len(sign)

    def lines_of(self, start: int, end: int) -> str:
        return _lines(self.text, start, end)


def _lines(text: str, start: int, end: int) -> str:
    first, last = text.rfind("\n", 0, start) + 1, text.find("\n", end)
    return " ".join(text[first : last if last >= 0 else len(text)].split())


def _eligible(node: ast.AST) -> Iterator[ast.AST]:
    """The node and all below it that may be changed."""
    if isinstance(node, ast.Import | ast.ImportFrom | ast.Assert | ast.Raise | ast.JoinedStr):
        return
    if _is_docstring(node):
        return
    yield node
    own = list(_indices(node))
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.keyword) and child.arg == "strict":
                continue  # of zip: a check that nothing relies on
            if isinstance(child, ast.AST):
                yield from (n for n in _eligible(child) if n not in own)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _changes(node: ast.AST, source: _Source) -> Iterator[tuple[str, tuple[int, int], str]]:
    if isinstance(node, ast.Constant):
        yield from _constant(node, source)
    elif isinstance(node, ast.Subscript) or getattr(node, "arg", "") == "axis":
        for index in _indices(node):
            yield "index", source.span(index), str(abs(index.value - 1))
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        (op,), (right,) = node.ops, node.comparators
        sign, negated = NEGATED[type(op)]
        place = source.between(node.left, right, sign)
        yield "comparison", place, negated
        if type(op) in STRICTNESS and (_whole(node.left) or _whole(right)):
            yield "strictness", place, STRICTNESS[type(op)]
    elif isinstance(node, ast.BinOp) and type(node.op) in SWAPPED and not _is_text(node):
        place = source.between(node.left, node.right, SIGNS[type(node.op)])
        yield "arithmetic", place, SWAPPED[type(node.op)]
    elif isinstance(node, ast.BoolOp):
        old, new = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        yield "and / or", source.between(*node.values[:2], old), new
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant):
        start = source.span(node)[0]
        length = len("not ") if isinstance(node.op, ast.Not) else len("-")
        yield "sign", (start, start + length), ""
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "condition", source.span(node.test), f"(not ({source.of(node.test)}))"
        yield "condition", source.span(node.test), "True"
        yield "condition", source.span(node.test), "False"
    elif isinstance(node, ast.comprehension):
        for test in node.ifs:
            yield "condition", source.span(test), "True"
    elif isinstance(node, ast.Assign | ast.AugAssign):
        yield from _statement(node, source)
    elif isinstance(node, ast.Call):
        yield from _call(node, source)


def _indices(node: ast.AST) -> Iterator[ast.Constant]:
    """The numbers that are an index, a slice's bound or an axis by themselves. Theirs become one
    less, as JAX clamps an index past the end, which may change nothing."""
    if isinstance(node, ast.Subscript):
        yield from _numbers(node.slice)
    elif isinstance(node, ast.keyword) and node.arg == "axis":
        yield from _numbers(node.value)


def _numbers(node: ast.expr) -> Iterator[ast.Constant]:
    if isinstance(node, ast.Constant) and type(node.value) is int:
        yield node
    elif isinstance(node, ast.Tuple | ast.Slice | ast.UnaryOp):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                yield from _numbers(child)


def _constant(node: ast.Constant, source: _Source) -> Iterator[tuple[str, tuple[int, int], str]]:
    value = node.value
    if isinstance(value, bool):
        yield "true / false", source.span(node), str(not value)
    elif isinstance(value, int):
        yield "number", source.span(node), str(value + 1)
        if value > 1:
            yield "number", source.span(node), str(2 * value)
    elif isinstance(value, float):
        new = 1.0 if value == 0 else value * (2 if value > GUARD else 1e6)
        yield "number", source.span(node), repr(new)


def _statement(
    node: ast.Assign | ast.AugAssign, source: _Source
) -> Iterator[tuple[str, tuple[int, int], str]]:
    if isinstance(node, ast.AugAssign):
        yield "step dropped", source.span(node), "pass"
        return
    target = node.targets[0]
    if isinstance(target, ast.Name) and len(node.targets) == 1:
        used = {n.id for n in ast.walk(node.value) if isinstance(n, ast.Name)}
        if target.id in used:
            yield "step dropped", source.span(node), "pass"


def _call(node: ast.Call, source: _Source) -> Iterator[tuple[str, tuple[int, int], str]]:
    function = node.func
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    start, end = source.span(function)
    if name in OPPOSITE:
        yield "min / max", (end - len(name), end), OPPOSITE[name]
    if any(isinstance(a, ast.Starred) for a in node.args):
        return
    of_arrays = re.fullmatch(r"(jnp|np|lax)(\.\w+)+", source.of(function)) is not None
    if name == "where" and len(node.args) == 3:
        yield from _swap(node.args[1], node.args[2], source)
    elif of_arrays and len(node.args) == 2 and name not in UNORDERED:
        yield from _swap(*node.args, source)
    elif (
        len(node.args) == 1 and not node.keywords and name not in KEPT_CALLS and name[:1].islower()
    ):
        if isinstance(function, ast.Name) or of_arrays:
            yield "call dropped", source.span(node), f"({source.of(node.args[0])})"


def _swap(a: ast.expr, b: ast.expr, source: _Source) -> Iterator[tuple[str, tuple[int, int], str]]:
    (start, first), (second, end) = source.span(a), source.span(b)
    between = source.text[first:second]
    yield "arguments", (start, end), source.of(b) + between + source.of(a)


def _whole(node: ast.expr) -> bool:
    """Whether the value is certainly a whole number, for which < and <= differ."""
    if isinstance(node, ast.Constant):
        return type(node.value) is int
    if isinstance(node, ast.Call):
        return getattr(node.func, "id", "") == "len"
    return isinstance(node, ast.Subscript) and getattr(node.value, "attr", "") == "shape"


def _is_text(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    return any(
        isinstance(s, ast.JoinedStr | ast.List | ast.Tuple)
        or (isinstance(s, ast.Constant) and isinstance(s.value, str))
        for s in sides
    ) or isinstance(getattr(node.left, "value", None), str)
