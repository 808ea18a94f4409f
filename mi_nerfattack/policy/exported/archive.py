"""What a ``.pt2`` file may hold: it is checked before torch reads it.

Reading a program, torch unpickles some parts, executes the guards as Python, evaluates
the sizes, and looks functions up by their names. Here only plain tensors, arithmetic
of sizes, and torch's own operators pass. That is no proof: a program is code all the
same, and comes from somebody who is trusted.
"""

from __future__ import annotations

import ast
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from mi_nerfattack.errors import InputError

#: Parts of a program that torch would unpickle, or load as native code.
_UNSAFE = ("custom_obj", "opaque_obj", "data/aotinductor")
#: Operators that read or write files.
_FILE_OPERATORS = re.compile(r"\b(?:torch|aten)\.(?:ops\.)?(save|from_file)\b")
_PYTHON_OPERATORS = (
    "getitem add sub mul floordiv truediv mod neg pow pos abs "
    "eq ne lt le gt ge and_ or_ not_"
)
_TARGET = re.compile(
    r"(torch\.ops\.(aten|prims|higher_order)\.[a-zA-Z_]\w*(\.\w+)?"
    rf"|_operator\.({'|'.join(_PYTHON_OPERATORS.split())})"
    r"|math\.[a-z]\w*|torch\.sym_\w+|)"
)
_NAME = re.compile(r"[\w.]*", re.ASCII)
_FUNCTIONS = frozenset(
    "Symbol Integer Float Rational Add Mul Pow Max Min Mod PythonMod FloorDiv CleanDiv "
    "IntTrueDiv FloatTrueDiv CeilToInt FloorToInt RoundToInt TruncToInt ToFloat Abs "
    "ModularIndexing Where Eq Equality Ne Unequality Lt StrictLessThan Le LessThan Gt "
    "StrictGreaterThan Ge GreaterThan And Or Not Identity Piecewise "
    "OpaqueUnaryFn_sqrt max min abs int float bool round".split()
)
_METHODS = frozenset(("size", "stride", "storage_offset"))
_NODES = (
    ast.Expression,
    ast.BinOp,
    ast.UnaryOp,
    ast.BoolOp,
    ast.Compare,
    ast.operator,
    ast.unaryop,
    ast.boolop,
    ast.cmpop,
    ast.expr_context,
    ast.Name,
    ast.Constant,
    ast.Subscript,
    ast.Call,
    ast.keyword,
    ast.Attribute,
    ast.Tuple,
)


def check_archive(path: Path, raw: bytes) -> None:
    """Refuse a ``.pt2`` file with more than plain tensors, operators and sizes.

    Raises:
        InputError: another format, pickled objects, or code; naming the part.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            names = archive.namelist()
            contents = {
                name: archive.read(name)
                for name in names
                if name.endswith(".json") or "/sample_inputs/" in name
            }
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as err:
        raise InputError(
            f"{path}: is no .pt2 file ({err}); write it with torch.export.save"
        ) from err
    models = [n for n in names if "/models/" in n]
    if len(set(names)) < len(names) or not models:
        raise InputError(
            f"{path}: holds no exported program; write it with torch.export.save of "
            "torch 2.9 or later"
        )
    unsafe = [n for n in names if any(part in n for part in _UNSAFE)]
    unsafe += [n for n in names if "/data/weights/" in n and n.endswith(".pt")]
    unsafe += [n for n in names if "/data/constants/" in n and n.endswith(".pt")]
    unsafe += [n for n in contents if n not in models and not _plain(n, contents[n])]
    unsafe += [n for n in models if n not in contents]
    if unsafe:
        raise InputError(
            f"{path}: {unsafe[0]}: pickled objects or native code, which are not "
            "loaded; export a program whose inputs and weights are plain tensors"
        )
    for name in models:
        _check_model(f"{path}: {name}", contents[name])


def check_script(path: Path, raw: bytes) -> None:
    """Refuse a TorchScript archive whose code reads or writes files.

    What is no archive passes: torch tells what it is.

    Raises:
        InputError: naming the operator.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(raw)) as archive:
            code = [archive.read(n) for n in archive.namelist() if n.endswith(".py")]
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError):
        return
    for text in code:
        found = _FILE_OPERATORS.search(text.decode("utf-8", "replace"))
        if found:
            raise InputError(
                f"{path}: calls {found[0]}, which reads or writes files; leave it out "
                "of the program"
            )


def _plain(name: str, data: bytes) -> bool:
    """Tell a list of plain tensors, or example inputs without other objects."""
    if name.endswith(".json"):
        try:
            entries = json.loads(data).get("config", {})
            return not any(entry.get("use_pickle") for entry in entries.values())
        except (ValueError, AttributeError, RecursionError):
            return False
    if not data:
        return True
    try:
        torch.load(io.BytesIO(data), weights_only=True)
    except Exception:
        return False
    return True


def _check_model(owner: str, data: bytes) -> None:
    """Check each text of a program that torch would execute or look up."""
    try:
        texts = list(_texts(json.loads(data), ""))
        wrong = [(k, t) for k, t in texts if not _CHECKS.get(k, _anything)(t)]
    except (ValueError, RecursionError) as err:
        raise InputError(f"{owner}: {err}; write it with torch.export.save") from err
    for key, text in wrong[:1]:
        raise InputError(
            f"{owner}: {key} {text[:80]!r}: is neither arithmetic of sizes nor an "
            "operator of torch, and is not executed; export the program again, without "
            "Python code of your own"
        )


def _texts(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Yield all texts of parsed JSON with the nearest key."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _texts(item, name)
    elif isinstance(value, list):
        for item in value:
            yield from _texts(item, key)
    elif isinstance(value, str):
        yield key, value


def _anything(text: str) -> bool:
    del text
    return True


def _target(text: str) -> bool:
    """Tell an operator of torch's that touches no file."""
    return bool(_TARGET.fullmatch(text)) and not _FILE_OPERATORS.search(text)


def _name(text: str) -> bool:
    return bool(_NAME.fullmatch(text))


def _tree(text: str) -> bool:
    """Tell a structure of tuples, lists and dicts: others import what they name."""
    kinds = {kind for key, kind in _texts(json.loads(text), "") if key == "type"}
    return kinds <= {"builtins.tuple", "builtins.list", "builtins.dict"}


def _arithmetic(text: str) -> bool:
    """Tell arithmetic and comparisons of sizes, in Python's syntax."""
    if not text.isascii() or any(sign in text for sign in "#\\\n\r"):
        return False
    try:
        tree = ast.parse(text.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError):
        return False
    nodes = list(ast.walk(tree))
    called = {id(n.func) for n in nodes if isinstance(n, ast.Call)}
    quoted = {id(part) for n in nodes for part in _places_of_text(n)}
    return all(_allowed(n, called, quoted) for n in nodes)


def _places_of_text(node: ast.AST) -> list[ast.expr]:
    """Return the parts that may be text: an index, or the name of a symbol."""
    if isinstance(node, ast.Subscript):
        return [node.slice]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return node.args if node.func.id in ("Symbol", "Float") else []
    return []


def _allowed(node: ast.AST, called: set[int], quoted: set[int]) -> bool:
    if isinstance(node, ast.Call):
        function = node.func
        if isinstance(function, ast.Attribute):
            return function.attr in _METHODS or _is_math(function)
        return isinstance(function, ast.Name) and function.id in _FUNCTIONS
    if isinstance(node, ast.Attribute):
        return id(node) in called or _is_math(node)
    if isinstance(node, ast.Constant):
        if isinstance(node.value, str):
            return id(node) in quoted and _name(node.value)
        return isinstance(node.value, (int, float))
    return isinstance(node, _NODES)


def _is_math(node: ast.Attribute) -> bool:
    owner = node.value
    return isinstance(owner, ast.Name) and owner.id == "math" and node.attr.isalpha()


_CHECKS: dict[str, Callable[[str], bool]] = {
    "guards_code": _arithmetic,
    "expr_str": _arithmetic,
    "target": _target,
    "as_operator": _target,
    "in_spec": _tree,
    "out_spec": _tree,
    "name": _name,
    "as_name": _name,
    "forward_arg_names": _name,
}
