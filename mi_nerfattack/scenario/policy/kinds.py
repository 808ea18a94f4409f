"""The section ``[policy]``: the policy under test, one section a kind of file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field, model_validator

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.io.network import read_token
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.policy.black_box import DIFFERENTIABLE_KINDS, CallablePolicy
from mi_nerfattack.policy.drjit_network import DrJitNetwork
from mi_nerfattack.policy.exported import load_exported, load_torchscript
from mi_nerfattack.policy.http.policy import HttpPolicy
from mi_nerfattack.policy.inputs import (
    Inputs,
    IntegerGoal,
    NoGoal,
    OneHotGoal,
    declared_goal,
)
from mi_nerfattack.policy.one_image import OneImage
from mi_nerfattack.policy.pilotnet import PilotNet, stored_unit
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.policy.weights import load_drjit_state, load_state
from mi_nerfattack.ranges import Natural, Positive
from mi_nerfattack.scenario.named_file import Code, File
from mi_nerfattack.scenario.policy.base import NO_VIEWS, AbstractPolicySection, Views
from mi_nerfattack.scenario.policy.openpilot import OpenpilotSection
from mi_nerfattack.scenario.section import Kinds, OneOrSeveral, read_section, refuse
from mi_nerfattack.scenario.user_code import check_trust

#: Kinds by the suffix of the file.
SUFFIXES = {
    ".safetensors": "pilotnet",
    ".py": "module",
    ".pt2": "exported",
    ".pt": "torchscript",
    ".onnx": "onnx",
}
Shapes = tuple[tuple[int, ...], ...]


class AbstractNetworkSection(AbstractPolicySection):
    """A network with derivatives."""

    file: File
    goal: Annotated[NoGoal | IntegerGoal | OneHotGoal, Kinds()] | None = None
    batch: Literal[1] | None = None  # where it takes one image at a time

    def policy_of(
        self,
        module: torch.nn.Module,
        views: Views,
        batch: int | None = None,
        recurrent: Shapes = (),
    ) -> TorchPolicy:
        """Join network, goal and preprocessing."""
        if (batch := self.batch or batch) not in (None, 1):
            raise InputError(
                f"{self.source}: takes exactly {batch} images at a time; export it "
                "with a free batch size, or for one image"
            )
        return TorchPolicy(
            module if batch is None else OneImage(module, recurrent),
            goal=declared_goal(module) if self.goal is None else self.goal,
            preprocess=self.preprocess.build(),
            recurrent=recurrent,
            action=self.action(),
            inputs=self.build_inputs(views),
            name=self.source,
        )

    def _made(self, kind: Any, description: str) -> Any:
        """Return the object of ``FILE.py:NAME``, or what calling it gives."""
        definition: Any = self.file.load("policy.file", self.trust_code)
        if isinstance(definition, MutableMapping | torch.nn.Module):
            result = definition  # a finished network of drjit.nn or torch.nn
        else:
            try:
                result = definition()
            except Exception as err:
                if is_interrupt(err):
                    raise
                raise InputError(
                    f"{self.source}: calling it without arguments raises "
                    f"{type(err).__name__}: {err}"
                ) from err
        if not isinstance(result, kind):
            raise InputError(
                f"{self.source}: gives a {type(result).__name__}; a {description} is "
                "needed"
            )
        return result


class PilotNetSection(AbstractNetworkSection):
    """PilotNet with a goal, of ``mi-nerfattack train``."""

    kind: Literal["pilotnet"] = "pilotnet"

    def unit(self) -> str | None:
        """Return the unit in the file, or in the key."""
        return self._stored_unit() or self.control_unit

    def _stored_unit(self) -> str | None:
        """Return the unit in the file; None if it is converted or unknown."""
        return stored_unit(self.file.file) if self.control_scale == 1 else None

    @model_validator(mode="after")
    def _check_unit(self) -> Any:
        if self.control_unit and self._stored_unit() not in (None, self.control_unit):
            refuse("control_unit", f"{self.source} says it in its file; leave it out")
        return self

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Load the network."""
        return self.policy_of(PilotNet.load(self.file.file), views)


class ModuleSection(AbstractNetworkSection):
    """A module of torch, made by Python code."""

    kind: Literal["module"]
    file: Code
    weights_file: File | None = None  # .safetensors, or a state dict .pt
    recurrent: Shapes = ()  # -1 for the vehicles

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Run the file and load the weights; refuse those that are drawn at random."""
        module = self._made(torch.nn.Module, "torch.nn.Module")
        if self.weights_file is not None:
            load_state(module, self.weights_file.file)
        else:
            self._refuse_drawn(module)
        return self.policy_of(module, views, recurrent=self.recurrent)

    def _refuse_drawn(self, module: torch.nn.Module) -> None:
        """Make the module once more, from other random numbers, and compare."""
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(int(torch.randint(1 << 62, ())))
            again = self._made(torch.nn.Module, "torch.nn.Module").state_dict()
        for name, value in module.state_dict().items():
            if not torch.equal(value, again.get(name, value)):
                raise InputError(
                    f"{self.source}: its weights are random: {name!r} differs each "
                    "time that it is made; give policy.weights_file, or load them in "
                    "the Python file"
                )


class ProgramSection(AbstractNetworkSection):
    """A network in a file of its own: of torch.export, of torch.jit, in ONNX."""

    kind: Literal["exported", "torchscript", "onnx"]
    recurrent: Shapes = ()
    #: Of the control, in an ONNX file with several; or names of several controls.
    output_name: OneOrSeveral[str] | None = None

    @property
    def _names(self) -> tuple[str, ...]:
        """Names of the outputs that are controls."""
        name = self.output_name or ()
        return name if isinstance(name, tuple) else (name,)

    @property
    def columns(self) -> int | tuple[int, ...] | None:
        """Columns of the controls; several outputs with names are columns."""
        several = len(self._names)
        if several > 1 and self.output is None:
            return tuple(range(several))
        return self.output

    @model_validator(mode="after")
    def _check_output_name(self) -> Any:
        if self.output_name is not None and self.kind != "onnx":
            refuse("output_name", "is of ONNX files alone; leave it out")
        return self

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Load the program."""
        path, batch = self.file.file, None
        if self.kind != "onnx":
            check_trust("policy.file", self.source, self.trust_code)
        if self.kind == "torchscript":
            network = load_torchscript(path)
        elif self.kind == "exported":
            network = load_exported(path)
            batch = network.batch
        else:
            network = _load_onnx(path)
            network.choose(self._names, len(self.recurrent))
            batch = network.batch
        return self.policy_of(network, views, batch, recurrent=self.recurrent)


class DrJitSection(AbstractNetworkSection):
    """A network of ``drjit.nn``, or a function in Dr.Jit operations."""

    kind: Literal["drjit"]
    file: Code
    weights_file: File | None = None  # .safetensors

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Run the file and load the weights."""
        network = self._made(Callable, "drjit.nn module or a function")
        if self.weights_file is not None:
            load_drjit_state(network, self.weights_file.file)
        return self.policy_of(DrJitNetwork(network), views)


class CallableSection(AbstractPolicySection):
    """A function of images without derivatives."""

    kind: Literal["callable"]
    file: Code

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Load the function."""
        preprocess, inputs = self.preprocess.build(), self.build_inputs(views)
        function = self.file.load("policy.file", self.trust_code)
        return CallablePolicy(
            function, self.source, preprocess, action=self.action(), inputs=inputs
        )


class HttpSection(AbstractPolicySection):
    """A server that answers images with controls."""

    kind: Literal["http"]
    url: str
    revision: str | None = None  # names the server's weights; results depend on it
    #: Results do not depend on these.
    timeout_s: Annotated[Positive, Field(exclude=True)] = 10.0  # of an answer
    retries: Annotated[Natural, Field(exclude=True)] = 2
    token_file: Annotated[File | None, Field(exclude=True)] = None
    later: ClassVar[tuple[str, ...]] = (*AbstractPolicySection.later, "revision")
    is_remote: ClassVar[bool] = True

    def build(self, views: Views = NO_VIEWS) -> AbstractPolicy:
        """Make the client."""
        return HttpPolicy(
            self.url,
            timeout_s=self.timeout_s,
            retries=self.retries,
            preprocess=self.preprocess.build(),
            action=self.action(),
            inputs=self.build_inputs(views),
            token="" if self.token_file is None else read_token(self.token_file.file),
        )

    def build_inputs(self, views: Views) -> Inputs:
        """Return the inputs; the client sends the frame of all cameras as it is."""
        inputs = super().build_inputs(views)
        if {*inputs.images} < {*views}:
            raise InputError(
                "policy.inputs: a server gets the images of all cameras side by side; "
                f"name {', '.join(views)}"
            )
        return inputs


def _kind_of(keys: dict[str, Any]) -> str:
    """Tell the kind by the suffix of the file, where it is left out."""
    file = keys.get("file")
    if (file is None) == (keys.get("url") is None):
        refuse("file", "give either file or url")
    if file is None:
        return "http"
    suffix = ".py" if ".py:" in str(file) else Path(str(file)).suffix.lower()
    if suffix in SUFFIXES:
        return SUFFIXES[suffix]
    if ":" in str(file):
        refuse(
            "file",
            f"{file}: code is given as FILE.py:NAME, with the path of a Python "
            "file; import modules of a package in such a file",
        )
    refuse(
        "file",
        f"{file}: its suffix tells no kind; give policy.kind, or one of "
        f"{', '.join(SUFFIXES)}",
    )


PolicySection = Annotated[
    PilotNetSection
    | ModuleSection
    | ProgramSection
    | OpenpilotSection
    | DrJitSection
    | CallableSection
    | HttpSection,
    Kinds(_kind_of, AbstractPolicySection),
]


def load_policy(
    keys: Mapping[str, Any], folder: str | Path = ".", views: Views = NO_VIEWS
) -> AbstractPolicy:
    """Make a policy.

    Args:
        keys: of a section ``[policy]``.
        folder: that its paths start from.
        views: as of `AbstractPolicySection.build`; those of a `Rig`.

    Raises:
        InputError: a key or a file cannot be used, see `AbstractPolicySection.build`.
    """
    return read_section("policy", PolicySection, dict(keys), folder=folder).build(views)


def build_differentiable(
    section: AbstractPolicySection, views: Views = NO_VIEWS
) -> AbstractPolicy:
    """Make a policy for a gradient method; `views` as of `AbstractPolicySection.build`.

    Raises:
        InputError: see `AbstractPolicySection.build`, or the policy is a black box.
    """
    policy = section.build(views)
    if not policy.differentiable:
        raise InputError(
            f"policy: {section.source}: is a black box, which has no derivatives; a "
            f"gradient attack takes the kinds {DIFFERENTIABLE_KINDS}"
        )
    return policy


def _load_onnx(path: Path) -> Any:
    from mi_nerfattack.policy.onnx.network import load_onnx  # an extra

    return load_onnx(path)
