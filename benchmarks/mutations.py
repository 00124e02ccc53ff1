"""Mutations of source code, drawn at random: places, the operators of cosmic-ray, and which mutations count.

A place is drawn first and then one of its mutations, so places with many mutations do not count more than others.
"""

import ast
import re
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sidestep.errors import InputError

FAMILIES = (
    frozenset({"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}),
    frozenset({"BitOr", "BitAnd", "BitXor", "RShift", "LShift"}),
    frozenset({"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"}),
    frozenset({"Is", "IsNot"}),
    frozenset({"Delete", "USub"}),
    frozenset({"Delete", "Invert"}),
    frozenset({"Delete", "Not"}),
)
"""An operator of source code is replaced by others of its family, or deleted."""
SPEED = frozenset({
    *("jit", "filter_jit", "keep_program", "compiled", "inlined", "part", "cache", "lru_cache", "checkpoint"),
    *("filter_checkpoint", "override", "abstractmethod", "runtime_checkable", "overload", "short_repr"),
})  # fmt: skip
"""Decorators that change speed, types or texts only."""
WITHOUT_EFFECT = frozenset(["strict", "stacklevel", "unroll", "nogil", "inline", "static", "static_argnames", "donate"])
"""Arguments that change no result of a call that is right."""
SPEED_CONSTANTS = frozenset({
    *("MEMORY", "LARGE_MAP", "SMALL_PROBLEM", "_BATCH", "_BLOCK_FACTOR", "_CHUNK", "_FIXED_WORKSPACE", "_MIN_LENGTH"),
    *("_MIN_BYTES_TO_TRIM", "_MIN_MOVES", "_MIN_STATES_PER_CORE", "_MIN_TASKS", "_MOST_FACTORIZED", "_NUMBERS"),
    *("_OUT_OF_ORDER", "_PROBABILITIES", "_ROLLOUTS", "_SMALL", "_SMALLEST_BLOCK", "_TOGETHER", "_WORKSPACE_PER_TASK"),
})  # fmt: skip
"""Constants of modules that decide how much is done at a time, for speed or memory, and no result."""
TEXTS = frozenset({"__repr__", "__str__", "_repr_html_"})
"""Functions that return texts for people."""
_BINARY = frozenset({"arith_expr", "term", "power", "expr", "xor_expr", "and_expr", "shift_expr", "atom_expr"})
"""Where an operator of parso's trees is a binary one, and not a star before an argument."""


class Mutation(NamedTuple):
    """A mutation: the file by its path from the root, the line, cosmic-ray's operator, and the mutated code."""

    file: str
    line: int
    operator: str
    code: str


class Site(NamedTuple):
    """A place that can be mutated, and its mutations: operators and the number of the place for each."""

    file: str
    line: int
    mutations: tuple[tuple[str, int], ...]


def draw_mutations(root: Path, package: str, count: int, seed: int) -> Iterator[Mutation]:
    """Yield mutations at different places of a package that may change a result, fewer if there are no more places."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    files = sorted(path for path in (root / package).rglob("*.py"))
    if not files:
        raise InputError(f"expected a folder of modules, found none in {root / package}", field="package")
    sites = [site for path in files for site in sites_of(path.read_text(), str(path.relative_to(root)))]
    generator = np.random.default_rng([seed, *package.encode()])
    drawn = 0
    for number in generator.permutation(len(sites)):
        site = sites[number]
        name, occurrence = site.mutations[generator.integers(len(site.mutations))]
        source = (root / site.file).read_text()
        code = mutate_code(source, get_operator(name)(), occurrence)
        if code is None or not may_change_result(source, code):
            continue
        yield Mutation(site.file, site.line, name.partition("/")[2], code)
        drawn += 1
        if drawn == count:
            return


def sites_of(source: str, file: str) -> Iterator[Site]:
    """Yield the places of a module that operators can mutate."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator

    nodes = list(ast_nodes(get_ast(source)))
    found: dict[tuple[int, int], list[tuple[str, int]]] = defaultdict(list)
    for name in _operator_names():
        operator, occurrence = get_operator(name)(), 0
        for node in nodes:
            for start, _ in operator.mutation_positions(node):
                if not name.startswith("core/ReplaceBinary") or node.parent.type in _BINARY:
                    found[start].append((name, occurrence))
                occurrence += 1
    for (line, _), mutations in sorted(found.items()):
        yield Site(file, line, tuple(mutations))


def _operator_names() -> list[str]:
    """Return the operators that need no arguments and stay within a family."""
    from cosmic_ray.plugins import operator_names

    return [name for name in operator_names() if _in_family(name.partition("/")[2]) and "Variable" not in name]


def _in_family(name: str) -> bool:
    kinds = re.fullmatch(r"Replace(?:Binary|Comparison|Unary)Operator_([A-Za-z]+)_([A-Za-z]+)", name)
    return kinds is None or any(family.issuperset(kinds.groups()) for family in FAMILIES)


# ---------------------------------------------------------------------------------------------------- what counts


def may_change_result(source: str, mutated: str) -> bool:
    """Return whether mutated code is valid and differs in more than what is left out (`benchmarks.mutants`)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            trees = [ast.parse(code) for code in (source, mutated)]
            compile(mutated, "mutated", "exec", dont_inherit=True)
    except SyntaxError:
        return False
    one, other = (ast.dump(_Essence().visit(tree)) for tree in trees)
    return one != other


class _Essence(ast.NodeTransformer):
    """Takes out of a syntax tree what cannot change a result."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns, node.decorator_list = None, _without_speed(node.decorator_list)
        node.body = [ast.Pass()] if node.name in TEXTS else node.body
        return self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        node.decorator_list = _without_speed(node.decorator_list)
        return self.generic_visit(node)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        node.annotation = None
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.annotation = ast.Constant(None)
        return ast.Pass() if _names(node.target) <= SPEED_CONSTANTS else self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        names = set().union(*(_names(target) for target in node.targets))
        return ast.Pass() if names <= SPEED_CONSTANTS else self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        # sizes are at least 1
        if _is_size(node.left) and [ast.dump(each) for each in node.comparators] == [ast.dump(ast.Constant(1))]:
            node.ops = [ast.Gt() if isinstance(op, ast.NotEq) else op for op in node.ops]
        return self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        return ast.Constant(None) if _is_type(node.left) or _is_type(node.right) else self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        exception = node.exc
        return ast.Raise(exception.func if isinstance(exception, ast.Call) else exception, None)

    def visit_Assert(self, node: ast.Assert) -> ast.AST:
        del node
        return ast.Pass()

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        del node
        return ast.Constant("")

    def visit_If(self, node: ast.If) -> ast.AST:
        names = [each.id for each in ast.walk(node.test) if isinstance(each, ast.Name)]
        return ast.Pass() if names == ["TYPE_CHECKING"] else self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        node.keywords = [each for each in node.keywords if each.arg not in WITHOUT_EFFECT]
        return self.generic_visit(node)


def _without_speed(decorators: Sequence[ast.expr]) -> list[ast.expr]:
    return [each for each in decorators if not SPEED.intersection(_names(each))]


def _names(node: ast.AST) -> set[str]:
    """Return all names and attributes in an expression."""
    names = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
    return names | {each.attr for each in ast.walk(node) if isinstance(each, ast.Attribute)}


def _is_size(node: ast.expr) -> bool:
    """Return whether an expression is the length of an axis: `array.shape[n]`."""
    return isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute) and node.value.attr == "shape"


def _is_type(node: ast.expr) -> bool:
    """Return whether an operand of `|` is a type: None, or a name in capitals and small letters."""
    if isinstance(node, ast.Subscript):
        node = node.value
    if isinstance(node, ast.Attribute):
        return bool(re.match(r"[A-Z]+[a-z]", node.attr))
    if isinstance(node, ast.Name):
        return bool(re.match(r"[A-Z]+[a-z]", node.id))
    return isinstance(node, ast.Constant) and node.value is None
