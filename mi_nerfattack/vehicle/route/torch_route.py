"""Reference paths in PyTorch."""

from __future__ import annotations

import torch

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.route.polyline import (
    Measures,
    Operations,
    Segment,
    measure,
    square_distance,
)
from mi_nerfattack.vehicle.route.route import Route

_TORCH = Operations(
    torch.where, torch.sqrt, torch.sin, torch.cos, torch.atan2, torch.Tensor.detach
)


class TorchRoute:
    """Arc length, cross-track error and heading error of a route by autograd.

    What they are, and where they jump, is said of `Route`; the numbers are the same.
    Memory: a few numbers for each pair of vehicle and segment while the nearest
    segment is looked for, outside of the graph.

    Args:
        route: open or closed.
    """

    def __init__(self, route: Route) -> None:
        self.route = route
        self._rows: dict[tuple[torch.device, torch.dtype], torch.Tensor] = {}

    def project(self, states: torch.Tensor) -> Measures:
        """Find the nearest point of the route.

        Args:
            states: (n, m), m >= 3, metres and radians, of any floating-point type and
                device.

        Returns:
            Tensors (n,) as those of `Route.project_numpy`, differentiable by `states`.

        Raises:
            InputError: no floating-point tensor of that shape.
        """
        kind = states.dtype
        if states.ndim != 2 or states.shape[1] < 3 or not kind.is_floating_point:
            raise InputError(
                f"states: {tuple(states.shape)} {kind}; a floating-point tensor (n, 3)"
            )
        rows = self._rows_like(states)
        x, y, theta = states[:, :3].unbind(1)
        with torch.no_grad():
            every = Segment(*rows.unbind(1))
            square = square_distance(_TORCH, every, x[:, None], y[:, None])
            nearest = Segment(*rows[square.argmin(1)].unbind(1))
        return measure(_TORCH, nearest, x, y, theta)

    def arc_length(self, states: torch.Tensor) -> torch.Tensor:
        """Arc length (n,) of the nearest points, metres, of states (n, m)."""
        return self.project(states).arc_length

    def cross_track(self, states: torch.Tensor) -> torch.Tensor:
        """Signed distance (n,) from the route, metres, positive on its left."""
        return self.project(states).cross_track

    def heading_error(self, states: torch.Tensor) -> torch.Tensor:
        """Heading (n,) relative to the route, radians in [-pi, pi]."""
        return self.project(states).heading_error

    def _rows_like(self, states: torch.Tensor) -> torch.Tensor:
        """Return the segments on the device and in the precision of the states."""
        key = states.device, states.dtype
        if key not in self._rows:
            rows = torch.tensor(self.route.segments, dtype=states.dtype)
            self._rows[key] = rows.to(states.device)
        return self._rows[key]
