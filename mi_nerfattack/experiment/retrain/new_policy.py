"""Policies that your own training writes, to replace the attacked policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from mi_nerfattack.deploy.environment import policy_image, trial_numbers
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.retrain.compare import read_with_policy
from mi_nerfattack.experiment.transfer.found import FoundAttack
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import json_digest
from mi_nerfattack.scenario.named_file import NamedFile, section_content
from mi_nerfattack.scenario.policy.kinds import AbstractPolicySection, PolicySection
from mi_nerfattack.scenario.section import read_section

#: Suffix of a file with a whole section ``[policy]``.
TOML = ".toml"


@dataclass(frozen=True, eq=False)
class Successor:
    """The policy that follows the attacked one: how it is written, and how it is read.

    It is one file. Either it takes the place of the attacked policy's weights and has
    their suffix, or it is TOML with a section ``[policy]``.

    Args:
        attacked: the policy that it follows.
    """

    attacked: AbstractPolicySection

    @cached_property
    def _named(self) -> tuple[str, NamedFile] | None:
        """Key and file of the weights, or else of the code; None of a server."""
        leaves = self.attacked.leaves()
        named = {str(k): v for (k, *_), v in leaves if isinstance(v, NamedFile)}
        key = "weights_file" if "weights_file" in named else "file"
        return (key, named[key]) if key in named else None

    @property
    def weights(self) -> tuple[str, NamedFile] | None:
        """Key and file of the weights; None where code or a server has them."""
        is_code = self._named is not None and self._named[1].function
        return None if is_code else self._named

    @property
    def file(self) -> Path | None:
        """The file that a training can start from; None of a server."""
        return None if self._named is None else self._named[1].file

    @property
    def content(self) -> dict[str, str]:
        """Name and checksum of this file; URL and revision of a server."""
        if self._named is None:
            revision = getattr(self.attacked, "revision", None)
            return {"url": self.attacked.source} | (
                {} if revision is None else {"revision": revision}
            )
        return self._named[1].content()

    def check_suffix(self, output: Path) -> None:
        """Raise `InputError` for a file that could not hold such a policy."""
        suffixes = [TOML]
        if self.weights is not None:
            suffixes.insert(0, self.weights[1].file.suffix)
        if output.suffix not in suffixes:
            raise InputError(
                f"-o: {output}; must end in {' or '.join(suffixes)}, as the attacked "
                f"policy {self.attacked.source} does or as a file with [policy]"
            )

    def setting(self, path: Path) -> str:
        """Return what makes the new policy of the attacked one: a value of ``--set``.

        Args:
            path: of the new policy.

        Raises:
            InputError: a TOML file that cannot be read, or is not a section [policy].
        """
        if path.suffix == TOML:
            return f"policy={_inline(read_keys(path))}"
        assert self.weights is not None  # by check_suffix
        return f"policy.{self.weights[0]}={_inline(str(path.resolve()))}"


def read_keys(path: Path) -> dict[str, Any]:
    """Read a file with a section ``[policy]`` alone; return its keys, files absolute.

    Raises:
        InputError: it cannot be read, has other sections, or names what is missing.
    """
    document = files.read_toml(path)
    if list(document) != ["policy"]:
        there = ", ".join(document) or "nothing"
        raise InputError(f"{path}: has {there}; a section [policy] alone is needed")
    keys = document["policy"]
    section = read_section(f"{path}: policy", PolicySection, keys, folder=path.parent)
    named = {name: getattr(section, name) for name in type(section).model_fields}
    named = {k: v.portable for k, v in named.items() if isinstance(v, NamedFile)}
    return {**keys, **named}


def try_policy(attack: FoundAttack, setting: str, attacked_again: bool) -> str:
    """Make a new policy and show it one grey image; return a digest of its content.

    Args:
        attack: whose scenario it is for.
        setting: of `Successor.setting`.
        attacked_again: whether the scenario's attack must be able to use it.

    Raises:
        InputError: it cannot be made, does not take the camera's images, or its control
            is not finite.
    """
    scenario, _ = read_with_policy(attack, setting)
    rig = scenario.rig()
    if attacked_again:
        policy = scenario.build_policy()
    else:
        policy = scenario.policy.build(rig.views)
    width, height = rig.size
    image = policy_image(np.full((height, width, 3), 128, np.uint8))
    numbers = trial_numbers(policy)
    row, _ = policy.step(image, attack.route.goal, policy.initial_memory(1), numbers)
    if not np.isfinite(np.array(row)).all():
        raise InputError(f"{scenario.policy.source}: gives the control {np.array(row)}")
    return json_digest(section_content(scenario.policy))


def install(path: Path, output: Path) -> None:
    """Copy a new policy to its place, atomically; TOML with absolute paths."""
    if path.suffix == TOML:
        files.write_text(output, tomlkit.dumps({"policy": read_keys(path)}))
    else:
        files.write_bytes(output, files.read_bytes(path, files.MAX_TENSOR_BYTES))


def _inline(value: Any) -> str:
    """Write a value of TOML in one line."""
    if isinstance(value, Mapping):
        pairs = [f"{_inline(key)} = {_inline(item)}" for key, item in value.items()]
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return tomlkit.item(value).as_string()
