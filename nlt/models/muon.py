"""Muon (Jordan et al. 2024): steps of a matrix are orthogonalised, so that all its directions learn equally fast."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

_MOMENTUM = 0.95
_ITERATIONS = 5
_ADAMS_STEP = 0.2  # root mean square of Adam's steps over its learning rate, as Liu et al. (2025) measured


def orthogonalize(matrix: Tensor) -> Tensor:
    """Return approximately U V' of the matrix U S V' (n, m): singular values become about 0.7 to 1.2.

    The coefficients of this Newton-Schulz iteration are Jordan's: they raise small singular values fastest.
    """
    x = matrix / (matrix.norm() + 1e-7)
    if x.shape[0] > x.shape[1]:
        return orthogonalize(x.T).T
    # Each iteration multiplies x by a polynomial of x x', so the product of these small (n, n) factors is enough.
    product = identity = torch.eye(len(x), dtype=x.dtype, device=x.device)
    square = x @ x.T
    for _ in range(_ITERATIONS):
        factor = 3.4445 * identity + (2.0315 * square @ square - 4.775 * square)
        product = factor @ product
        square = factor @ square @ factor
    return product @ x


class Muon(torch.optim.Adam):
    """Muon for the groups with `orthogonal: True`, whose tensors have at least two axes; Adam for all other groups.

    A convolution's weight is a matrix with a row per output channel. The steps are as large as Adam's would be, so
    that both take the same learning rate (Liu et al. 2025, "Muon is scalable for LLM training").
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """Take a step and return what `closure` returned."""
        with torch.enable_grad():
            loss = closure() if closure else None
        for group in self.param_groups:
            for weight in group["params"] if group.get("orthogonal") else ():
                if weight.grad is None:
                    continue
                # Adam asks every state for its step when it is loaded.
                state = self.state[weight] or {"step": torch.zeros(()), "momentum": torch.zeros_like(weight)}
                self.state[weight] = state
                momentum = state["momentum"].lerp_(weight.grad, 1 - _MOMENTUM)
                rows = weight.grad.lerp(momentum, _MOMENTUM).flatten(1)
                size = _ADAMS_STEP * max(rows.shape) ** 0.5
                weight.sub_(orthogonalize(rows).view(weight.shape), alpha=group["lr"] * size)
                weight.grad = None  # so that Adam leaves it alone
        super().step()
        return loss
