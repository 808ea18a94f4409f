"""ONNX files as torch modules: an interpreter with the derivatives of torch.

Of our own because an attack needs the derivative by the image, and runtimes have none
for inference graphs. The converter onnx2pytorch makes rollouts slower. Its import needs
torchvision, whose registry build does not load with the CPU build of torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_iter, tree_map

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.extras import load_extra
from mi_nerfattack.io import files
from mi_nerfattack.policy.checks import misfit
from mi_nerfattack.policy.onnx.call import Call
from mi_nerfattack.policy.onnx.operators import OPERATORS


class Budget(TorchDispatchMode):
    """Refuses what makes more than so many bytes of values; a context manager.

    The size of a value is found by making it without memory, on torch's device
    ``meta``. Costs about 0.1 ms an operation.

    Args:
        limit: bytes.
    """

    def __init__(self, limit: int) -> None:
        super().__init__()
        self.limit = self.left = limit

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # its import takes seconds

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if not func.is_view:
            without = {**kwargs, "device": _META} if "device" in kwargs else kwargs
            try:
                made = func(*tree_map(_meta, args), **tree_map(_meta, without))
            except (RuntimeError, TypeError, ValueError):
                made = ()  # the operation itself tells, or its size is of its values
            for value in tree_iter(made):
                if isinstance(value, torch.Tensor):
                    self.left -= value.numel() * value.element_size()
            if self.left < 0:
                raise InputError(
                    f"its values take more than {self.limit / 1e9:.1f} GB for these "
                    "images; export a smaller network, or give fewer or smaller images"
                )
        return func(*args, **kwargs)


_META = torch.device("meta")


def _meta(value: Any) -> Any:
    return value.to(_META) if isinstance(value, torch.Tensor) else value


MAX_ONNX_BYTES = 1 << 31
MAX_VALUE_BYTES = 1 << 30  # of all nodes, an image
_DOUBLE = 11
#: What torch and NumPy raise where a node's values or attributes do not fit.
_UNUSABLE = (
    RuntimeError,
    TypeError,
    ValueError,
    IndexError,
    KeyError,
    ArithmeticError,
)
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Node:
    """An operator of the graph, and the names of what it reads and writes."""

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]


@dataclass(frozen=True)
class Input:
    """An input of the graph: its name, whether it is integer, and its sizes.

    A size is None where it is free.
    """

    name: str
    is_integer: bool
    sizes: tuple[int | None, ...]


class OnnxNetwork(torch.nn.Module):
    """Graph of ONNX operators, evaluated one by one.

    Arguments go to the graph's inputs in the graph's order, and its outputs come back
    in the graph's order. Floating constants are buffers, so that ``.double()`` and
    ``.to(device)`` work; all floating types are one in an evaluation. Each node is
    about 20 us slower than in a runtime, because Python calls it.

    Attributes:
        batch: the number of images that it takes, None where any.
    """

    def __init__(self, model: Any, name: str, rounds: bool = False) -> None:
        """Take a ``ModelProto`` apart; see `load_onnx`, `name` is for messages."""
        super().__init__()
        self.name = name
        self.rounds = rounds
        self.opset: int = _opset(model, name)
        graph = model.graph
        self.integers: dict[str, torch.Tensor] = {}
        self.floating: dict[str, str] = {}
        nodes = [_node(node, name) for node in graph.node]
        self._read_constants(graph, nodes)
        self.nodes: list[Node] = [node for node in nodes if node.operator != "Constant"]
        known = {*self.integers, *self.floating}
        self.inputs: list[Input] = [
            _input(i) for i in graph.input if i.name not in known
        ]
        self.outputs: list[Any] = [output.name for output in graph.output]
        self.controls = 1  # of the outputs, those that are joined
        if not self.inputs or not self.inputs[0].sizes:
            raise InputError(f"{name}: has no image among its inputs")
        self.batch: int | None = self.inputs[0].sizes[0]
        self._measured: set[tuple[torch.Size, ...]] = set()

    def choose(self, controls: Sequence[str], hidden: int) -> None:
        """Choose the outputs that are controls; the hidden states come after them.

        Args:
            controls: names; several become the columns of one answer. None where the
                control is the first of 1 + `hidden` outputs.
            hidden: number of hidden states; without any, other outputs are left out.

        Raises:
            InputError: there is no such output, or their number does not fit.
        """
        names = self.outputs
        if not controls and len(names) == 1 + hidden:
            return
        listed = ", ".join(map(repr, names))
        if not controls or not set(controls) <= set(names):
            raise InputError(
                f"{self.name}: has the outputs {listed}, and policy.output_name is "
                f"{list(controls)}: give the name of the control there, or those of "
                f"several; policy.recurrent declares {hidden} hidden states"
            )
        hidden_names = (
            [other for other in names if other not in controls] if hidden else []
        )
        if len(hidden_names) != hidden:
            raise InputError(
                f"{self.name}: has the outputs {listed}; beside the controls "
                f"{list(controls)} there must be {hidden} hidden states, as "
                "policy.recurrent declares"
            )
        self.outputs, self.controls = [*controls, *hidden_names], len(controls)

    def forward(self, *arguments: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Evaluate all nodes; the first time of these sizes, by a budget of memory."""
        sizes = tuple(argument.shape for argument in arguments)
        if sizes in self._measured or not sizes:
            return self._run(arguments)
        with Budget(MAX_VALUE_BYTES * max(1, *sizes[0][:1])):
            result = self._run(arguments)
        self._measured.add(sizes)
        return result

    def _run(self, arguments: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
        dtype = next((b.dtype for b in self.buffers()), arguments[0].dtype)
        device = arguments[0].device
        values: dict[str, torch.Tensor] = dict(self.integers)
        for name, buffer in self.floating.items():
            values[name] = self.get_buffer(buffer)
        values.update(self._bound(arguments, dtype))
        for node in self.nodes:
            inputs = [values[name] if name else None for name in node.inputs]
            call = Call(
                node.operator, inputs, node.attributes, self.opset, dtype, device
            )
            result = self._evaluate(node, call)
            results = result if isinstance(result, tuple) else (result,)
            for name, value in zip(node.outputs, results, strict=False):
                values[name] = value
        outputs = [values[name] for name in self.outputs]
        if self.controls > 1:
            columns = [
                value.reshape(len(value), -1) for value in outputs[: self.controls]
            ]
            outputs[: self.controls] = [torch.cat(columns, 1)]
        return tuple(outputs)

    def _evaluate(self, node: Node, call: Call) -> Any:
        try:
            return OPERATORS[node.operator](call)
        except InputError as err:
            raise InputError(f"{self.name}: node {node.name}: {err}") from err
        except _UNUSABLE as err:
            if is_interrupt(err) or isinstance(err, torch.OutOfMemoryError):
                raise
            raise InputError(
                f"{self.name}: node {node.name} ({node.operator}): {err}"
            ) from err

    def _bound(
        self, arguments: tuple[torch.Tensor, ...], dtype: torch.dtype
    ) -> dict[str, torch.Tensor]:
        """Match arguments with the graph's inputs."""
        names = [item.name for item in self.inputs]
        if len(arguments) != len(names):
            raise InputError(
                f"{self.name}: has the inputs {names}; image, goal and hidden states "
                f"are {len(arguments)}: set policy.goal and policy.recurrent"
            )
        for item, value in zip(self.inputs, arguments, strict=True):
            pairs = zip(item.sizes, value.shape, strict=False)
            wrong = any(size not in (None, actual) for size, actual in pairs)
            if wrong or len(item.sizes) != value.ndim:
                if item is self.inputs[0]:
                    reason = misfit(item.sizes, value.shape)
                    raise InputError(f"{self.name}: {reason}")
                sizes = ["any" if size is None else size for size in item.sizes]
                raise InputError(
                    f"{self.name}: input {item.name!r} has the shape {sizes}; it gets "
                    f"{list(value.shape)}: set policy.goal and policy.recurrent"
                )
        return {
            item.name: self._converted(item, value, dtype)
            for item, value in zip(self.inputs, arguments, strict=True)
        }

    def _converted(
        self, item: Input, value: torch.Tensor, dtype: torch.dtype
    ) -> torch.Tensor:
        """Return an argument in the type of its input."""
        if not item.is_integer:
            return value.to(dtype)
        if self.rounds and value.is_floating_point():
            value = value.to(dtype)
            return value + (value.detach().round() - value.detach())
        return value.to(torch.int64)

    def _read_constants(self, graph: Any, nodes: list[Node]) -> None:
        """Keep initial values: floating ones as buffers, others on the CPU."""
        double = any(i.type.tensor_type.elem_type == _DOUBLE for i in graph.input[:1])
        dtype = torch.float64 if double else torch.float32
        if len(graph.sparse_initializer):
            raise InputError(f"{self.name}: sparse tensors are not supported")
        values = [(t.name, _tensor(t, self.name)) for t in graph.initializer]
        for node in nodes:
            if node.operator == "Constant":
                call = Call("Constant", (), node.attributes, self.opset, dtype, _CPU)
                values.append((node.outputs[0], self._evaluate(node, call)))
        for name, value in values:
            if value.is_floating_point():
                self.floating[name] = f"constant_{len(self.floating)}"
                self.register_buffer(self.floating[name], value.to(dtype))
            else:
                self.integers[name] = value


def load_onnx(path: Path, rounds: bool = False) -> OnnxNetwork:
    """Read an ``.onnx`` file with its weights inside.

    Args:
        path: of the file.
        rounds: accept images of integers. They are given as floating numbers, which
            are rounded; the derivative of the rounding is taken as 1.

    Raises:
        InputError: no such file, another format, weights in other files, or operators
            that are not supported, by name.
        SetupError: the package ``onnx`` is not installed.
    """
    onnx = load_extra("onnx", f"{path}: reading it")
    raw = files.read_bytes(path, MAX_ONNX_BYTES)
    try:
        model = onnx.load_model_from_string(raw)
        outside = _outside(model)
        if not outside:
            onnx.checker.check_model(model)
    # a damaged file makes onnx raise whatever its parser stumbles over
    except Exception as err:
        reason = str(err).strip().split("\n")[0]
        raise InputError(
            f"{path}: is no ONNX model ({reason}); write or copy it again"
        ) from err
    if outside:
        raise InputError(
            f"{path}: keeps {outside[0]!r} in another file; save it with the weights "
            "inside: onnx.save(onnx.load(FILE), FILE)"
        )
    network = OnnxNetwork(model, str(path), rounds)
    if network.inputs[0].is_integer and not rounds:
        raise InputError(
            f"{path}: input {network.inputs[0].name!r}, the image, is of integers, "
            "which have no derivative; export the network with a float input, and "
            "scale the image by policy.preprocess.scale"
        )
    return network


def _outside(model: Any) -> list[str]:
    """Return names of tensors whose data is in other files."""
    external = 1  # TensorProto.EXTERNAL
    tensors = list(model.graph.initializer)
    for node in model.graph.node:
        tensors += [t for item in node.attribute for t in (item.t, *item.tensors)]
    return [t.name or "a constant" for t in tensors if t.data_location == external]


def _opset(model: Any, name: str) -> int:
    """Return the version of the standard operators; refuse unknown operators."""
    domains = {item.domain: item.version for item in model.opset_import}
    unknown = sorted(
        {
            f"{node.domain}.{node.op_type}" if node.domain else node.op_type
            for node in model.graph.node
            if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS
        }
    )
    if unknown:
        raise InputError(
            f"{name}: operators {', '.join(unknown)} are not supported; supported are "
            f"{', '.join(sorted(OPERATORS))}"
        )
    return int(domains.get("", domains.get("ai.onnx", 1)))


def _node(node: Any, owner: str) -> Node:
    TensorProto = load_extra("onnx", "a policy of ONNX").TensorProto
    helper = load_extra("onnx.helper", "a policy of ONNX")
    attributes: dict[str, Any] = {"outputs": len(node.output)}
    for item in node.attribute:
        value = helper.get_attribute_value(item)
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        elif isinstance(value, (list, tuple)):
            value = [v.decode() if isinstance(v, bytes) else v for v in value]
        elif isinstance(value, TensorProto):
            value = _tensor(value, owner)
        attributes[item.name] = value
    name = node.name or f"that gives {node.output[0]!r}"
    return Node(node.op_type, name, tuple(node.input), tuple(node.output), attributes)


def _tensor(tensor: Any, owner: str) -> torch.Tensor:
    """Read a tensor; floating ones as at least single precision."""
    to_array = load_extra("onnx.numpy_helper", "a policy of ONNX").to_array
    try:
        array = np.array(to_array(tensor))
        if array.dtype.kind in "iub":
            return torch.from_numpy(
                array.astype(_INTEGER_TYPES.get(array.dtype, array.dtype))
            )
        double = array.dtype == np.float64
        return torch.from_numpy(array.astype(np.float64 if double else np.float32))
    except (KeyError, TypeError, ValueError) as err:
        why = f"unknown type {err}" if isinstance(err, KeyError) else err
        raise InputError(f"{owner}: tensor {tensor.name!r}: {why}") from err


#: Types that torch lacks or hardly computes with.
_INTEGER_TYPES = {np.dtype(f"uint{bits}"): np.int64 for bits in (16, 32, 64)}


def _input(value: Any) -> Input:
    kind = value.type.tensor_type
    sizes = tuple(
        size.dim_value if size.HasField("dim_value") and size.dim_value > 0 else None
        for size in kind.shape.dim
    )
    floating = kind.elem_type in (1, 10, 11, 16)
    return Input(value.name, not floating, sizes)
