"""Derivatives of functions of Dr.Jit arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr


def differentiates_rays(integrator: Any) -> bool:
    """Tell whether an integrator has the protocol of Mitsuba's `RBIntegrator`.

    By the name of its base class: other packages and changes of variant leave several
    copies of that class in a process.
    """
    return any(base.__name__ == "RBIntegrator" for base in type(integrator).__mro__)


def vjp(f: Callable[[Any], Any], x: Any, dy: Any) -> Any:
    """Multiply a cotangent by the derivative of a function (reverse mode).

    The function is evaluated again, with gradients even where the caller suspended
    them. Other arrays that `f` reads get their gradients, too, if they are attached.

    Args:
        f: maps a PyTree of arrays to a PyTree of arrays.
        x: where to differentiate; itself stays detached or attached as it is.
        dy: cotangent of ``f(x)``, of the same structure; a number stands for equal
            entries.

    Returns:
        cotangent of `x`, of its structure and shapes; detached, not evaluated.

    Raises:
        ValueError: ``f(x)`` does not depend on `x`.
    """
    with dr.resume_grad():
        leaf = dr.detach(x)
        dr.enable_grad(leaf)
        y = f(leaf)
        if not dr.grad_enabled(y):
            raise ValueError("vjp: the result does not depend on the argument")
        dr.accum_grad(y, dy)  # not set: two entries of y may be one variable
        dr.enqueue(dr.ADMode.Backward, y)
        dr.traverse(dr.ADMode.Backward)
        return dr.grad(leaf)
