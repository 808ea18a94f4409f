from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import drjit as dr
import mitsuba as mi
import pytest

from mi_nerfattack import variant
from mi_nerfattack.backend import llvm
from mi_nerfattack.errors import SetupError
from mi_nerfattack.system import before_drjit

ROOT = Path(__file__).parents[2]
needs_package = pytest.mark.skipif(
    not any(
        name.lower() == llvm.PACKAGE
        for item in importlib.metadata.distributions()
        if (name := item.metadata["Name"])
    ),
    reason=f"{llvm.PACKAGE} is not for this platform",
)


def run_python(code: str, **variables: str) -> list[str]:
    """Run code in a process without LLVM or variant settings of this one."""
    ours = (llvm.VARIABLE, variant.VARIABLE)
    environment = {
        name: value for name, value in os.environ.items() if name not in ours
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.fixture
def without_variable(monkeypatch):
    monkeypatch.delenv(llvm.VARIABLE, raising=False)


@needs_package
def test_package_is_found_and_loaded_in_a_fresh_process():
    ensured, active_variant, origin, major, *_ = run_python(
        "import mi_nerfattack, mi_nerfattack.backend.llvm as llvm, mitsuba as mi\n"
        "print(mi_nerfattack.backend.variant.ensure(), mi.variant())\n"
        "print(llvm.locate().origin, *llvm.check_version())"
    )
    assert (ensured, active_variant, origin) == (
        "llvm_ad_rgb",
        "llvm_ad_rgb",
        "package",
    )
    assert 19 <= int(major) < 24


@needs_package
def test_package_library_is_the_real_file(without_variable):
    library = llvm.locate()
    assert library.origin == "package" and library.path is not None
    assert library.path.is_file() and not library.path.is_symlink()


#: What a .pth file imports, without one.
HOOK = f"runpy; runpy.run_path({before_drjit.__file__!r})"
ORDER = """
import {first}
import os, sys
assert "drjit" not in sys.modules and "mi_nerfattack" not in sys.modules
import mitsuba as mi
assert "mi_nerfattack" not in sys.modules, "nobody asked for it"
mi.set_variant("llvm_ad_rgb")
import mi_nerfattack
from mi_nerfattack.backend import llvm
assert not {{"torch", "scipy", "matplotlib"}} & set(sys.modules), "who only renders"
print(llvm.check_version()[0], os.environ[llvm.VARIABLE])
"""


@needs_package
@pytest.mark.parametrize("first", [HOOK, "os"])
def test_mitsuba_may_be_imported_first(first):
    """By the file's code, and by Python where the package is installed."""
    installed = Path(sysconfig.get_path("purelib"), "mi_nerfattack_llvm.pth")
    if first == "os" and not installed.is_file():
        pytest.skip("installed before there was the file; install it again")
    major, path = run_python(ORDER.format(first=first))
    assert int(major) >= 19 and str(llvm._find_in_package()) == path


def test_the_user_s_variable_stays_when_mitsuba_is_imported_first():
    words = run_python(
        f"import {HOOK}\nimport drjit, os, sys\n"
        f"print(os.environ['{llvm.VARIABLE}'], 'mi_nerfattack' in sys.modules)",
        **{llvm.VARIABLE: "/nowhere/libLLVM.so"},
    )
    assert words == ["/nowhere/libLLVM.so", "False"]


def test_users_variable_is_kept(monkeypatch):
    monkeypatch.setenv(llvm.VARIABLE, "/opt/mine/libLLVM.so")
    assert llvm.setup() == llvm.Library(Path("/opt/mine/libLLVM.so"), "variable")
    assert os.environ[llvm.VARIABLE] == "/opt/mine/libLLVM.so"


def test_wrong_variable_is_named_and_not_replaced():
    words = run_python(
        "import mi_nerfattack\n"
        "try:\n    mi_nerfattack.backend.variant.ensure()\n"
        "except mi_nerfattack.SetupError as err:\n    print(err)",
        **{llvm.VARIABLE: "/nowhere/libLLVM.so"},
    )
    assert any(word.startswith("/nowhere/libLLVM.so") for word in words)


def test_variable_is_left_alone_once_drjit_is_loaded(without_variable):
    assert "drjit" in sys.modules
    llvm.setup()
    assert llvm.VARIABLE not in os.environ


@pytest.mark.parametrize(
    ("version", "allowed"), [((-1, -1, -1), "install"), ((16, 0, 0), "LLVM 16.* 17 ")]
)
def test_missing_and_old_libraries_are_refused(
    monkeypatch, without_variable, version, allowed
):
    monkeypatch.setattr(llvm, "_find_in_package", lambda: None)
    monkeypatch.setattr(llvm, "_system_folders", lambda: [])
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: version)
    with pytest.raises(SetupError, match=allowed):
        llvm.check_version()
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (17, 0, 0))
    assert llvm.check_version() == (17, 0, 0)


@needs_package
def test_late_import_is_told_what_to_do(monkeypatch, without_variable):
    monkeypatch.setattr(dr.detail, "llvm_version", lambda: (15, 0, 7))
    with pytest.raises(SetupError) as refused:
        llvm.check_version()
    assert "import mi_nerfattack before" in refused.value.remedy


def test_newest_system_library_of_19_or_more_is_taken(
    monkeypatch, tmp_path, without_variable
):
    folders = [tmp_path]
    monkeypatch.setattr(llvm, "_find_in_package", lambda: None)
    monkeypatch.setattr(llvm, "_system_folders", lambda: folders)
    expected = {14: None, 18: None, 21: 21, 19: 21}
    for major, newest in expected.items():
        folders.append(tmp_path / f"llvm-{major}" / "lib")
        folders[-1].mkdir(parents=True)
        (folders[-1] / f"libLLVM-{major}.so.1").touch()
        path = newest and tmp_path / f"llvm-{newest}/lib/libLLVM-{newest}.so.1"
        library = llvm.Library(path, "system" if path else "dr.jit")
        assert llvm.locate() == library
    (tmp_path / "libLLVM.so").symlink_to(folders[-1])  # a folder
    assert llvm.locate() == library


@needs_package
def test_runtime_is_loaded_where_the_links_are_missing(tmp_path):
    """Copy the package's libraries without its links, as before its first start."""
    path, *loaded = run_python(
        f"""
import importlib.metadata, pathlib, shutil, sys
top = pathlib.Path({str(tmp_path)!r})
"""
        + """
class File:
    def __init__(self, path):
        self.name, self._path = path.name, path
    def locate(self):
        return self._path

copies = []
for file in importlib.metadata.files("karellen-llvm-core"):
    source = pathlib.Path(file.locate())
    if ".so" in file.name and not source.is_symlink() and file.name != "libc++.so":
        sub = source.parent.name if "unknown" in source.parent.name else ""
        (top / "lib" / sub).mkdir(parents=True, exist_ok=True)
        copies.append(File(top / "lib" / sub / file.name))
        shutil.copy(source, top / "lib" / sub / file.name)
    elif ".so" in file.name:
        copies.append(File(top / "lib" / file.name))
importlib.metadata.files = lambda name: copies
import mi_nerfattack
import mi_nerfattack.backend.llvm as llvm
print(llvm.locate().path)
assert llvm.check_version()[0] >= 19
maps = pathlib.Path("/proc/self/maps").read_text()
print(str(top / "lib") in maps, "libc++.so.1.0" in maps)
"""
    )
    assert path.startswith(str(tmp_path)) and loaded == ["True", "True"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("scalar_rgb", "derivatives"),
        ("llvm_ad_mono_polarized", "polarised"),
        ("metal_ad_rgb", "Metal"),
    ],
)
def test_variants_that_the_plugins_do_not_run_in_are_refused(monkeypatch, name, reason):
    known = [*mi.variants(), "metal_ad_rgb"]  # which Mitsuba has on macOS
    monkeypatch.setattr(mi, "variants", lambda: known)
    monkeypatch.setattr(mi, "variant", lambda: name)
    with pytest.raises(SetupError, match=reason) as refused:
        variant.ensure()
    assert "llvm_ad_rgb" in refused.value.remedy
    assert name not in variant.usable()


def test_unknown_variant_is_refused(monkeypatch):
    monkeypatch.setattr(mi, "variant", lambda: None)
    monkeypatch.setenv(variant.VARIABLE, "llvm_rgb")
    with pytest.raises(SetupError, match="'llvm_rgb'") as refused:
        variant.ensure()
    assert refused.value.where == variant.VARIABLE
    assert "llvm_ad_rgb" in refused.value.remedy


def test_variant_of_the_environment_is_set():
    code = (
        "import mi_nerfattack, mitsuba as mi\n"
        "print(mi_nerfattack.backend.variant.ensure(), mi.variant())"
    )
    words = run_python(code, **{variant.VARIABLE: "llvm_ad_mono"})
    assert words == ["llvm_ad_mono"] * 2


def test_a_set_variant_is_kept(no_variant_left):
    mi.set_variant("llvm_ad_mono")
    assert variant.ensure() == "llvm_ad_mono"


def test_failing_registration_does_not_stop_the_change(
    monkeypatch, caplog, no_variant_left
):
    def fail(name: str) -> None:
        raise ValueError(f"broken plugin in {name}")

    monkeypatch.setattr(variant, "obstacle", fail)  # which the plugins ask first
    mi.set_variant("llvm_ad_mono")
    mi.set_variant("llvm_ad_rgb")
    assert mi.variant() == "llvm_ad_rgb"
    assert "plugins not registered for llvm_ad_rgb" in caplog.text
