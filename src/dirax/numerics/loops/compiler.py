"""From a Python function of loops over arrays to LLVM's code: the part of Python that such functions need.

A function may assign numbers and elements of arrays, and has `for … in range(…)`, `while`, `if`, `break`, `continue`, arithmetic,
comparisons, `abs`, `min` and `max`. Its arguments are arrays, `Doubles`, `Ints` or `Longs`, which may not overlap. Called as
plain Python it does the same.
"""

import ast
import inspect
import textwrap
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeAlias

import llvmlite.ir as ir
import numpy as np

DOUBLE, INDEX, INT, BIT = ir.DoubleType(), ir.IntType(64), ir.IntType(32), ir.IntType(1)
KINDS = {"f8": DOUBLE, "i8": INDEX, "i4": INT}
Doubles: TypeAlias = Annotated[np.ndarray, "f8"]
Ints: TypeAlias = Annotated[np.ndarray, "i4"]
Longs: TypeAlias = Annotated[np.ndarray, "i8"]
COMPARED: dict[type[ast.cmpop], str] = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


def argument_kinds(function: Callable) -> dict[str, str]:
    """The arguments of a function with the types of their numbers."""
    return {name: p.annotation.__metadata__[0] for name, p in inspect.signature(function).parameters.items()}


def module_of(function: Callable, constants: Mapping[str, int]) -> ir.Module:
    """A module with the function under its own name; `constants` are the values of names that are no arguments.

    Raises `SyntaxError` for what is not in the part of Python above.
    """
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(tree, ast.FunctionDef)
    module, kinds = ir.Module(), argument_kinds(function)
    made = ir.Function(
        module,
        ir.FunctionType(ir.VoidType(), [KINDS[kind].as_pointer() for kind in kinds.values()]),
        tree.name,
    )
    for argument in made.args:
        argument.add_attribute("noalias")
    _Body(made, dict(zip(kinds, made.args, strict=True)), constants).write(tree.body)
    return module


class _Body:
    """The body of a function while it is written: where variables live, and the loops around."""

    def __init__(self, function: ir.Function, arguments: dict[str, Any], constants: Mapping[str, int]):
        self.entry = ir.IRBuilder(function.append_basic_block("entry"))
        self.b: Any = ir.IRBuilder(function.append_basic_block("body"))
        self.arguments, self.constants = arguments, constants
        self.variables: dict[str, Any] = {}
        self.loops: list[tuple[Any, Any]] = []  # where to go on, where to end

    def write(self, statements: list[ast.stmt]) -> None:
        first = self.b.block
        self.block(statements)
        self.b.ret_void()
        self.entry.branch(first)

    def block(self, statements: list[ast.stmt]) -> None:
        for statement in statements:
            if self.b.block.is_terminated:
                return
            getattr(self, f"_{type(statement).__name__}", self._unknown)(statement)

    def _unknown(self, node: ast.AST) -> Any:
        raise SyntaxError(f"{ast.unparse(node)!r} is not in the part of Python that loops are compiled from")

    # ------------------------------------------------------------------------------------------------ statements

    def _Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self._unknown(node)

    def _Assign(self, node: ast.Assign) -> None:
        (target,) = node.targets
        self.store(target, self.value(node.value))

    def _AugAssign(self, node: ast.AugAssign) -> None:
        left = ast.copy_location(ast.parse(ast.unparse(node.target), mode="eval").body, node)
        self.store(node.target, self._BinOp(ast.BinOp(left, node.op, node.value)))

    def store(self, target: ast.expr, value: Any) -> None:
        if isinstance(target, ast.Name):
            if target.id not in self.variables:
                self.variables[target.id] = self.entry.alloca(value.type)
            place = self.variables[target.id]
        else:
            place = self.place(target)
        kind = place.type.pointee
        if kind == DOUBLE and value.type == INDEX:
            value = self.b.sitofp(value, DOUBLE)
        elif kind == INT:
            value = self.b.trunc(value, INT)
        self.b.store(value, place)

    def place(self, target: ast.expr) -> Any:
        if not isinstance(target, ast.Subscript) or not isinstance(target.value, ast.Name):
            return self._unknown(target)
        return self.b.gep(self.arguments[target.value.id], [self.value(target.slice)])

    def _If(self, node: ast.If) -> None:
        test = self.value(node.test)
        then, other, end = (self.b.append_basic_block() for _ in range(3))
        self.b.cbranch(test, then, other)
        for block, body in ((then, node.body), (other, node.orelse)):
            self.b.position_at_end(block)
            self.block(body)
            if not self.b.block.is_terminated:
                self.b.branch(end)
        self.b.position_at_end(end)

    def _While(self, node: ast.While) -> None:
        head, body, end = (self.b.append_basic_block() for _ in range(3))
        self.b.branch(head)
        self.b.position_at_end(head)
        self.b.cbranch(self.value(node.test), body, end)
        self.b.position_at_end(body)
        self.around(node.body, head, end)
        self.b.position_at_end(end)

    def _For(self, node: ast.For) -> None:
        call: Any = node.iter
        given = [self.value(a) for a in call.args]
        start, stop = (ir.Constant(INDEX, 0), given[0]) if len(given) == 1 else given[:2]
        step = given[2] if len(given) == 3 else ir.Constant(INDEX, 1)
        counter = self.entry.alloca(INDEX)  # the variable itself may be assigned in the body
        self.b.store(start, counter)
        head, body, advance, end = (self.b.append_basic_block() for _ in range(4))
        self.b.branch(head)
        self.b.position_at_end(head)
        down = isinstance(step, ir.Constant) and step.constant < 0
        self.b.cbranch(self.b.icmp_signed(">" if down else "<", self.b.load(counter), stop), body, end)
        self.b.position_at_end(body)
        self.store(node.target, self.b.load(counter))
        self.around(node.body, advance, end)
        self.b.position_at_end(advance)
        self.b.store(self.b.add(self.b.load(counter), step, flags=["nsw"]), counter)
        self.b.branch(head)
        self.b.position_at_end(end)

    def around(self, body: list[ast.stmt], again: Any, end: Any) -> None:
        self.loops.append((again, end))
        self.block(body)
        self.loops.pop()
        if not self.b.block.is_terminated:
            self.b.branch(again)

    def _Break(self, node: ast.Break) -> None:
        self.b.branch(self.loops[-1][1])

    def _Continue(self, node: ast.Continue) -> None:
        self.b.branch(self.loops[-1][0])

    # ----------------------------------------------------------------------------------------------- expressions

    def value(self, node: ast.expr) -> Any:
        return getattr(self, f"_{type(node).__name__}", self._unknown)(node)

    def _Constant(self, node: ast.Constant) -> Any:
        return ir.Constant(DOUBLE if isinstance(node.value, float) else INDEX, node.value)

    def _Name(self, node: ast.Name) -> Any:
        if node.id in self.variables:
            return self.b.load(self.variables[node.id])
        if node.id in self.constants:
            return ir.Constant(INDEX, self.constants[node.id])
        return self.arguments[node.id]

    def _Subscript(self, node: ast.Subscript) -> Any:
        value = self.b.load(self.place(node))
        return self.b.sext(value, INDEX) if value.type == INT else value

    def _UnaryOp(self, node: ast.UnaryOp) -> Any:
        value = self.value(node.operand)
        if isinstance(node.op, ast.Not):
            return self.b.not_(value)
        if isinstance(value, ir.Constant):
            return ir.Constant(value.type, -value.constant)
        return self.b.fneg(value) if value.type == DOUBLE else self.b.neg(value)

    def _BinOp(self, node: ast.BinOp) -> Any:
        a, b = self.alike(self.value(node.left), self.value(node.right), isinstance(node.op, ast.Div))
        real = a.type == DOUBLE
        match node.op:
            case ast.Add():
                return self.b.fadd(a, b) if real else self.b.add(a, b, flags=["nsw"])
            case ast.Sub():
                return self.b.fsub(a, b) if real else self.b.sub(a, b, flags=["nsw"])
            case ast.Mult():
                return self.b.fmul(a, b) if real else self.b.mul(a, b, flags=["nsw"])
            case ast.Div():
                return self.b.fdiv(a, b)
            case ast.FloorDiv():
                return self.b.sdiv(a, b)
            case ast.Mod():
                return self.b.srem(a, b)
        return self._unknown(node)

    def alike(self, a: Any, b: Any, real: bool = False) -> tuple[Any, Any]:
        real = real or DOUBLE in (a.type, b.type)
        a, b = (self.b.sitofp(x, DOUBLE) if real and x.type == INDEX else x for x in (a, b))
        return a, b

    def _Compare(self, node: ast.Compare) -> Any:
        (operator,), (right,) = node.ops, node.comparators
        if type(operator) not in COMPARED:
            self._unknown(node)
        a, b = self.alike(self.value(node.left), self.value(right))
        sign = COMPARED[type(operator)]
        return self.b.fcmp_ordered(sign, a, b) if a.type == DOUBLE else self.b.icmp_signed(sign, a, b)

    def _BoolOp(self, node: ast.BoolOp) -> Any:
        """The first alone where it decides: the others may read past the end of an array."""
        place, end = self.entry.alloca(BIT), self.b.append_basic_block()
        for test in node.values:
            value = self.value(test)
            self.b.store(value, place)
            more = self.b.append_basic_block()
            self.b.cbranch(value, *((more, end) if isinstance(node.op, ast.And) else (end, more)))
            self.b.position_at_end(more)
        self.b.branch(end)
        self.b.position_at_end(end)
        return self.b.load(place)

    def _IfExp(self, node: ast.IfExp) -> Any:
        return self.b.select(self.value(node.test), *self.alike(self.value(node.body), self.value(node.orelse)))

    def _Call(self, node: ast.Call) -> Any:
        name, given = getattr(node.func, "id", ""), [self.value(a) for a in node.args]
        if name == "abs" and given[0].type == DOUBLE:
            return self.b.call(self.b.module.declare_intrinsic("llvm.fabs", [DOUBLE]), given)
        if name in ("min", "max"):
            a, b = self.alike(*given)
            sign = "<" if name == "min" else ">"
            test = self.b.fcmp_ordered(sign, a, b) if a.type == DOUBLE else self.b.icmp_signed(sign, a, b)
            return self.b.select(test, a, b)
        return self._unknown(node)
