"""The one order of imports, read off the source without running it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from mi_nerfattack.io import files

ROOT = Path(__file__).parents[1]
PACKAGE = "mi_nerfattack"
# Each part imports only what stands to its left.
ORDER = (
    "errors extras ranges notebook backend io system vehicle policy scenes fields "
    "render rollout capture plugins attack deploy drives fit scenario evaluation "
    "training report experiment car props commands cli bench"
).split()
# Parts that can be used without torch; `vehicle` wraps it for its users.
WITHOUT_TORCH = "errors io scenes fields render rollout capture plugins deploy".split()
# What the computer of a car need not have, and parts whose import loads none of it.
NOT_IN_A_CAR = {"mitsuba", "drjit", "torch", "mujoco", "gymnasium", "pandas"}
NOT_IN_A_CAR |= {"matplotlib", "jinja2", "trimesh", "skimage", "onnx"}
IN_A_CAR = ("car", "commands", "cli")


def modules() -> Iterator[tuple[str, Path]]:
    """Yield the name and file of every module of the source tree."""
    for folder in (PACKAGE, "plugins", "scenes", "bench"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            names = path.relative_to(ROOT).with_suffix("").parts
            if folder in ("plugins", "scenes"):
                names = (PACKAGE, *names)
            yield ".".join(names[:-1] if names[-1] == "__init__" else names), path


SOURCES = dict(modules())


def imported(name: str, is_deep: bool = True) -> Iterator[str]:
    """Yield the full names that a module imports, in its functions too if deep."""
    path = SOURCES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in walk(ast.parse(path.read_text("utf-8"), str(path)), is_deep):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*up, base] if base else up)
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield full if full in SOURCES else base


def walk(tree: ast.AST, is_deep: bool) -> Iterator[ast.AST]:
    """Yield the nodes of a tree but for what only a type checker sees."""
    if isinstance(tree, ast.If) and ast.unparse(tree.test) == "TYPE_CHECKING":
        return
    if isinstance(tree, ast.FunctionDef) and not is_deep:
        return
    yield tree
    for child in ast.iter_child_nodes(tree):
        yield from walk(child, is_deep)


def loaded_with(name: str) -> Iterator[str]:
    """Yield a module and its packages."""
    while name:
        yield name
        name = name.rpartition(".")[0]


def part(name: str) -> str:
    """Return the part that a module belongs to."""
    return name.removeprefix(f"{PACKAGE}.").split(".")[0]


OWN = {
    name: {item for item in imported(name) if item in SOURCES} - {name, PACKAGE}
    for name in SOURCES
    if name != PACKAGE
}


def test_no_module_imports_to_its_right():
    wrong = [
        f"{name} imports {target}"
        for name, targets in OWN.items()
        for target in sorted(targets)
        if ORDER.index(part(target)) > ORDER.index(part(name))
    ]
    assert not wrong, "\n".join(wrong)


def test_no_two_modules_import_each_other():
    # A package's __init__ re-exports its modules, which is no dependency on them.
    graph = {
        name: targets
        for name, targets in OWN.items()
        if SOURCES[name].name != "__init__.py"
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as err:
        pytest.fail(f"modules import each other: {err.args[1]}")


def test_folders_are_small_and_no_family_of_prefixes():
    for folder in {path.parent for path in SOURCES.values()}:
        if not folder.is_relative_to(ROOT / PACKAGE):
            continue
        names = [path.stem for path in folder.glob("*.py") if path.stem[0] != "_"]
        assert len(names) <= 12 or folder.name == "commands", f"{folder}: {names}"
        heads = [name.split("_")[0] for name in names]
        families = {head for head in heads if heads.count(head) >= 3}
        assert not families, f"{folder}: {families}: a missing folder"


def test_a_car_needs_no_renderer():
    """Neither a module of these parts nor what its import loads imports any of it."""
    waiting = [name for name in SOURCES if part(name) in IN_A_CAR]
    chains = {name: name for name in waiting}
    assert f"{PACKAGE}.car.drive.rig" in chains and f"{PACKAGE}.cli" in chains
    for name in waiting:  # which grows
        for target in imported(name, is_deep=False):
            chain = f"{chains[name]} imports {target}"
            assert target.split(".")[0] not in NOT_IN_A_CAR, chain
            for item in loaded_with(target):
                if item in SOURCES and item not in chains:
                    chains[item] = chain
                    waiting.append(item)
    assert f"{PACKAGE}.render.camera.intrinsics" in chains


def test_no_module_unpickles_and_parts_need_no_torch():
    for name in SOURCES:
        roots = {item.split(".")[0] for item in imported(name)}
        assert not roots & {"pickle", "dill", "cloudpickle", "shelve"}, name
        assert part(name) not in WITHOUT_TORCH or "torch" not in roots, name


def test_only_io_opens_files():
    for name, path in SOURCES.items():
        if part(name) in ("io", "scenes"):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "open", f"{name}, line {node.lineno}"


def test_every_folder_is_packaged():
    table = files.read_toml(ROOT / "pyproject.toml")["tool"]["setuptools"]
    present = {
        name if path.name == "__init__.py" else name.rpartition(".")[0]
        for name, path in SOURCES.items()
        if part(name) != "bench"
    }
    assert present == set(table["packages"])


def test_the_walk_sees_imports_inside_functions():
    assert f"{PACKAGE}.system.doctor" in OWN[f"{PACKAGE}.commands.doctor"]
