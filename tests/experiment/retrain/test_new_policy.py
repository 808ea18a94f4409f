"""Which file follows an attacked policy, and how it gets into a scenario."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomlkit
from support.faults.refusals import refusals

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.retrain.new_policy import Successor, install, read_keys
from mi_nerfattack.io import files
from mi_nerfattack.scenario.policy.kinds import PolicySection
from mi_nerfattack.scenario.section import read_section

CODE = {"file": "a.py:Net", "trust_code": True}
#: Keys of a policy, the key that a new file replaces, and the file to start from.
POLICIES = [
    ({"file": "a.safetensors"}, "file", "a.safetensors"),
    ({"file": "a.onnx", "output": 1}, "file", "a.onnx"),
    ({"file": "a.pt2", "trust_code": True}, "file", "a.pt2"),
    ({"file": "a.bin", "kind": "torchscript"}, "file", "a.bin"),
    ({**CODE, "weights_file": "w.pt"}, "weights_file", "w.pt"),
    ({**CODE, "kind": "drjit", "weights_file": "w.safetensors"}, "weights_file", None),
    (CODE, None, "a.py"),
    ({**CODE, "kind": "callable"}, None, "a.py"),
    ({"url": "http://127.0.0.1:9"}, None, None),
]


def successor(folder: Path, keys: dict) -> Successor:
    for name in ("a.py", "a.safetensors", "a.onnx", "a.pt2", "a.bin", "w.pt"):
        (folder / name).write_bytes(b"x")
    (folder / "w.safetensors").write_bytes(b"x")
    return Successor(read_section("policy", PolicySection, keys, folder))


@pytest.mark.parametrize(("keys", "key", "file"), POLICIES)
def test_a_new_file_replaces_weights_or_the_whole_section(tmp_path, keys, key, file):
    policy = successor(tmp_path, keys)
    start = keys.get("weights_file") if file is None else file
    assert policy.file == (None if start is None else tmp_path / start)
    if "url" in keys:
        assert policy.content == {"url": keys["url"]}
    else:
        assert policy.content["file"].partition(":")[0] == start
    policy.check_suffix(Path("new.toml"))
    if key is None:
        with pytest.raises(InputError, match=r"new.safetensors; must end in \.toml,"):
            policy.check_suffix(Path("new.safetensors"))
        return
    suffix = Path(keys[key]).suffix
    policy.check_suffix(Path(f"new{suffix}"))
    with pytest.raises(InputError, match=rf"must end in \{suffix} or \.toml"):
        policy.check_suffix(Path("new.other"))
    path = tmp_path / f'a "b"{suffix}'
    setting = policy.setting(path)
    assert tomlkit.parse(setting)["policy"][key] == str(path)


def test_a_whole_section_is_written_in_one_line_and_read_anywhere(tmp_path):
    folder = tmp_path / "made"
    folder.mkdir()
    policy = successor(folder, {"url": "http://127.0.0.1:9"})
    text = '[policy]\nfile = "a.py:Net"\nweights_file = "w.pt"\ntrust_code = true\n'
    text += '[policy.preprocess]\nmean = [0.5, 1]\ncolour = "bgr"\n'
    (folder / "new.toml").write_text(text)
    keys = tomlkit.parse(policy.setting(folder / "new.toml")).unwrap()["policy"]
    assert keys == {
        "file": f"{folder / 'a.py'}:Net",
        "weights_file": str(folder / "w.pt"),
        "trust_code": True,
        "preprocess": {"mean": [0.5, 1], "colour": "bgr"},
    }
    install(folder / "new.toml", tmp_path / "installed.toml")
    assert files.read_toml(tmp_path / "installed.toml") == {"policy": keys}


def of_text(text: str):
    def call(folder: Path) -> None:
        (folder / "new.toml").write_text(text)
        read_keys(folder / "new.toml")

    return call


test_a_file_without_a_policy_is_refused = refusals(
    (of_text(""), r"new.toml: has nothing; a section \[policy\] alone"),
    (of_text("[policy]\nfile = 'a.pt2'\n[camera]\n"), "has policy, camera; "),
    (of_text("[policy]\nfil = 'a.pt2'\n"), "new.toml: policy.file: give either"),
    (of_text("[policy]\nfile = 'a.pt2'\nspeed = 1\n"), "policy.speed: unknown key; "),
    (of_text("policy = 1\n"), "new.toml: policy: "),
)
