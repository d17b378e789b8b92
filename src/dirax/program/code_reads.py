"""What the code of a function reads from outside of it, and what it changes there, by its instructions."""

import dis
import functools
import types
from typing import NamedTuple

CHANGES = {*("append", "extend", "insert", "add", "update", "setdefault", "pop", "popitem", "remove", "clear", "sort", "reverse")}
"""Methods that change lists, dictionaries and sets, in which a function may keep a record."""

Chain = tuple[str, ...]
"""Where a value on the stack comes from: a name of outside, "" for one of its own, and the attributes that lead from it."""

OWN: Chain = ("",)

KINDS = {
    **{"LOAD_NAME": "LOAD_GLOBAL", "LOAD_METHOD": "LOAD_ATTR", "IMPORT_FROM": "LOAD_ATTR"},
    **{"STORE_GLOBAL": "STORE", "STORE_DEREF": "STORE"},
}
"""Instructions that read or set as another one does."""

NAMES = {"LOAD_GLOBAL", "LOAD_NAME", "LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF"}

BY_TEXT = {"getattr", "attrgetter", "vars", "__dict__"}
"""By which attributes are read whose names are texts."""


class Reads(NamedTuple):
    """The names that code reads as globals and as attributes, those that it sets, those of what it changes, in which it may keep
    a record, and those of the modules that it imports."""

    globals: frozenset[str]
    attributes: frozenset[str]
    own: frozenset[str]
    changed: frozenset[str]
    modules: frozenset[str]

    @property
    def others(self) -> frozenset[str]:
        """The attributes that it reads and does not change."""
        return self.attributes - self.changed


@functools.lru_cache(maxsize=1024)
def reads(code: types.CodeType) -> Reads:
    """Of code and of the functions inside it."""
    names: dict[str, set[str]] = {
        **{"LOAD_GLOBAL": set(), "LOAD_ATTR": set(), "STORE": set()},
        **{"CHANGED": _changed(code), "IMPORT_NAME": set()},
    }
    for i in dis.get_instructions(code):
        if (place := KINDS.get(i.opname, i.opname)) in names:
            names[place].add(i.argval)
    if not BY_TEXT.isdisjoint(names["LOAD_GLOBAL"] | names["LOAD_ATTR"]):
        names["LOAD_ATTR"].update(text for text in code.co_consts if isinstance(text, str) and text.isidentifier())
    inner = [reads(c) for c in code.co_consts if isinstance(c, types.CodeType)]
    whole = zip(names.values(), Reads._fields, strict=True)
    return Reads(*(frozenset(own).union(*(getattr(r, name) for r in inner)) for own, name in whole))


def _changed(code: types.CodeType) -> set[str]:
    """The names of outside, and of attributes, that lead to what is changed: by what may be on the stack, in the order of the
    instructions. A local name leads where it was made to lead first."""
    stack: list[Chain] = []
    locals_: dict[str, Chain] = {}
    changed: set[str] = set()

    def pop(count: int = 1) -> Chain:
        last = OWN
        for _ in range(count):
            last = stack.pop() if stack else OWN
        return last

    for i in dis.get_instructions(code):
        name = i.opname
        if name == "LOAD_GLOBAL" and (i.arg or 0) & 1 and _pushes_null(i):
            stack.append(OWN)
        if name in NAMES:
            stack.append((i.argval,))
        elif name.startswith("LOAD_FAST") and isinstance(i.argval, str):
            stack.append(locals_.get(i.argval, OWN))
        elif name in ("LOAD_ATTR", "LOAD_METHOD"):
            chain = (*pop(), i.argval)
            if i.argval in CHANGES:
                changed.update(chain[:-1])
            stack.extend([chain] * (1 + dis.stack_effect(i.opcode, i.arg)))
        elif name == "BINARY_SUBSCR" or (name == "BINARY_OP" and i.argrepr == "[]"):
            pop()
        elif name == "COPY":
            stack.append(stack[-i.argval] if len(stack) >= i.argval else OWN)
        elif name == "SWAP":
            if len(stack) >= i.argval:
                stack[-i.argval], stack[-1] = stack[-1], stack[-i.argval]
        elif name in ("STORE_SUBSCR", "DELETE_SUBSCR"):
            changed.update(pop(2))
            pop(name == "STORE_SUBSCR")
        elif name == "STORE_SLICE":
            changed.update(pop(3))
            pop()
        elif name in ("STORE_ATTR", "DELETE_ATTR"):
            changed.update((*pop(), i.argval))
            pop(name == "STORE_ATTR")
        elif name == "STORE_FAST":
            locals_.setdefault(i.argval, pop())
        else:
            effect = dis.stack_effect(i.opcode, i.arg, jump=False)
            pop(max(-effect, 0))
            if stack and effect <= 0 and not name.startswith(("STORE", "POP", "DELETE", "JUMP", "RETURN", "NOP", "CACHE")):
                stack[-1] = OWN
            stack.extend([OWN] * max(effect, 0))
    return changed - {""}


def _pushes_null(i: dis.Instruction) -> bool:
    """Whether the name is one that is called, with a place on the stack for that."""
    return dis.stack_effect(i.opcode, i.arg) == 2
