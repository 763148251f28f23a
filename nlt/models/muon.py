"""Muon (Jordan et al. 2024): steps of a matrix are orthogonalised, so that all its directions learn equally fast."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

_MOMENTUM = 0.95
_ITERATIONS = 5
_ADAMS_STEP = 0.2  # root mean square of Adam's steps over its learning rate, as Liu et al. (2025) measured


def orthogonalize(matrices: Sequence[Tensor]) -> list[Tensor]:
    """Return approximately U V' of each matrix U S V' (n, m): singular values become about 0.7 to 1.2.

    The coefficients of this Newton-Schulz iteration are Jordan's: they raise small singular values fastest.
    """
    wide = [x if x.shape[0] <= x.shape[1] else x.T for x in matrices]
    wide = [x / (x.norm() + 1e-7) for x in wide]
    # Each iteration multiplies x by a polynomial of x x', so the product of these small (n, n) factors is enough. It is
    # computed for all matrices of the same n at once, because a product of so small matrices costs little but its call.
    factors = {}
    for n in {len(x) for x in wide}:
        square = torch.stack([x @ x.T for x in wide if len(x) == n])
        product = identity = torch.eye(n, dtype=square.dtype, device=square.device)
        for _ in range(_ITERATIONS):
            factor = 3.4445 * identity + (2.0315 * square @ square - 4.775 * square)
            product = factor @ product
            square = factor @ square @ factor
        factors[n] = iter(product)
    wide = [next(factors[len(x)]) @ x for x in wide]
    return [x if x.shape == matrix.shape else x.T for x, matrix in zip(wide, matrices, strict=True)]


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
            weights = [weight for weight in group["params"] if weight.grad is not None and group.get("orthogonal")]
            directions = []
            for weight in weights:
                # Adam asks every state for its step when it is loaded.
                state = self.state[weight] or {"step": torch.zeros(()), "momentum": torch.zeros_like(weight)}
                self.state[weight] = state
                momentum = state["momentum"].lerp_(weight.grad, 1 - _MOMENTUM)
                directions.append(weight.grad.lerp(momentum, _MOMENTUM).flatten(1))
                weight.grad = None  # so that Adam leaves it alone
            for weight, direction in zip(weights, orthogonalize(directions), strict=True):
                size = _ADAMS_STEP * max(direction.shape) ** 0.5
                weight.sub_(direction.view(weight.shape), alpha=group["lr"] * size)
        super().step()
        return loss
