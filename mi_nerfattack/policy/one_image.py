"""Networks that take one image at a time, as many exported ones do."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from mi_nerfattack.errors import InputError


class OneImage(torch.nn.Module):
    """Call a network once for each vehicle and put its answers side by side.

    Costs n calls where another network costs one of n images.

    Args:
        network: takes batches of one.
        recurrent: shapes of its hidden states, -1 for the number of vehicles.
    """

    def __init__(
        self, network: torch.nn.Module, recurrent: Sequence[Sequence[int]] = ()
    ) -> None:
        super().__init__()
        self.network = network
        self.axes: list[int] = [tuple(shape).index(-1) for shape in recurrent]

    def forward(
        self, image: torch.Tensor, *further_inputs: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the control and the hidden states of all vehicles.

        Raises:
            InputError: the network gives more outputs, or fewer.
        """
        goals = len(further_inputs) - len(self.axes)
        axes = [0] * (1 + goals) + self.axes
        answers = []
        for i in range(len(image)):
            one = [
                part.narrow(axis, i, 1)
                for part, axis in zip((image, *further_inputs), axes, strict=True)
            ]
            result = self.network(*one)
            result = result if isinstance(result, (tuple, list)) else (result,)
            if len(result) != 1 + len(self.axes):
                raise InputError(
                    f"policy.recurrent: {len(self.axes)} hidden states; the network "
                    f"gives {len(result)} outputs, the control and {len(result) - 1} "
                    "hidden states: declare their shapes, or return several controls "
                    "as one tensor (n, k) and tell the column by policy.output"
                )
            answers.append((result[0].reshape(1, -1), *result[1:]))
        columns = zip(*answers, strict=True)
        joined = zip(columns, [0, *self.axes], strict=True)
        return tuple(torch.cat(column, axis) for column, axis in joined)
