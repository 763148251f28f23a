"""The recipe of a training: schedule, clipping, the rate of embeddings, and how the U-Net's output becomes an image."""

from __future__ import annotations

import lightning as L
import pytest
import scipy.linalg
import torch
from synthetic import PHOTONS, POINTS, SCENES, synthetic_batch
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, SequentialLR
from torch.utils.data import DataLoader

from nlt.baselines.cnn import CNN
from nlt.baselines.denoising import SparseDenoising
from nlt.baselines.feature_projection import FeatureProjection
from nlt.callbacks import Checkpoints
from nlt.models.module import warm_up_and_cosine
from nlt.models.muon import Muon, orthogonalize
from nlt.models.nlt import NeuralLightTransport

SIZE = {"width": 4, "num_scenes": SCENES, "num_points": POINTS}
QUIET = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False, "accelerator": "cpu"}


def loader(count):
    return DataLoader([synthetic_batch(seed=k) for k in range(count)], batch_size=None)


class Rates(L.Callback):
    """Keeps the learning rates of every step, and the norm of the gradients that the optimiser sees."""

    def __init__(self):
        self.rates, self.norms = [], []

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        self.rates.append([group["lr"] for group in optimizer.param_groups])

    def on_train_batch_end(self, trainer, pl_module, *_):
        self.norms.append(
            float(torch.cat([p.grad.flatten() for p in pl_module.parameters() if p.grad is not None]).norm())
        )


def test_the_cosine_schedule_is_torchs():
    """5 % of linear warm-up, then half a cosine to zero, as PyTorch's own schedulers have it."""
    steps, warm_up = 200, 10
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
    parts = [LinearLR(optimizer, 1 / warm_up, 1, warm_up - 1), CosineAnnealingLR(optimizer, steps - warm_up)]
    schedule = SequentialLR(optimizer, parts, [warm_up])
    for step in range(steps):
        assert warm_up_and_cosine(step, steps) == pytest.approx(optimizer.param_groups[0]["lr"], abs=1e-9), step
        optimizer.step()
        schedule.step()
    assert warm_up_and_cosine(steps, steps) == pytest.approx(0, abs=1e-12)
    assert [warm_up_and_cosine(step, 1) for step in (0, 1)] == [1, 1]


@pytest.mark.parametrize("optimizer", ["adam", "muon"])
def test_the_rate_changes_at_every_step_and_resumes_exactly(tmp_path, optimizer):
    """Eight steps in one go, or four, a checkpoint and four more: the same rates, the same weights to the bit."""
    data = loader(4)

    def fit(*callbacks, **given):
        torch.manual_seed(0)
        model = FeatureProjection(
            **SIZE, lr_schedule="cosine", embedding_lr=0.1, learning_rate=0.01, optimizer=optimizer
        )
        rates, kept = Rates(), Checkpoints()
        trainer = L.Trainer(default_root_dir=tmp_path, max_steps=8, callbacks=[rates, kept, *callbacks], **QUIET)
        trainer.fit(model, data, **given)
        return kept.best_model_path, model, rates.rates

    _, through, whole = fit()
    steps = [0.01 * warm_up_and_cosine(step, 8) for step in range(8)]
    torch.testing.assert_close(
        torch.tensor(whole), torch.tensor([[*[rate] * (1 + (optimizer == "muon")), 0.1 * rate] for rate in steps])
    )
    half, _, first = fit(_StopAfter(4))
    _, resumed, rest = fit(ckpt_path=half, weights_only=True)
    assert first + rest == whole
    for a, b in zip(through.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)


class _StopAfter(L.Callback):
    def __init__(self, steps):
        self.steps = steps

    def on_train_batch_end(self, trainer, *_):
        trainer.should_stop = trainer.global_step >= self.steps


def test_gradients_are_clipped(tmp_path):
    rates = Rates()
    L.Trainer(default_root_dir=tmp_path, max_steps=8, gradient_clip_val=1e-3, callbacks=[rates], **QUIET).fit(
        CNN(width=4), loader(8)
    )
    assert rates.norms == pytest.approx([1e-3] * 8, rel=1e-3)


def test_a_demodulated_output():
    """Albedo times three channels, plus three, over the exposure, plus what lamps in view emit."""
    batch, method = synthetic_batch(), CNN(width=4, output="demodulated").eval()
    channels = torch.randn(2, 6, 16, 16)
    method.unet.forward = lambda *_: channels
    expected = batch["albedo"] * channels[:, :3] + channels[:, 3:]
    expected = expected / batch["exposure"].view(-1, 1, 1, 1) + batch["emission"]
    torch.testing.assert_close(method(batch), expected)
    assert method.fields == (*method.inputs, "emission")
    dark = CNN(width=4, output="demodulated", add_emission=False)
    assert dark.fields == dark.inputs and not dark(batch).isnan().any()
    direct = CNN(width=4, output="demodulated", direct_light=True)
    direct.unet.forward = lambda *_: channels
    expected += (batch["seen_albedo"] - batch["albedo"]) * channels[:, :3] / batch["exposure"].view(-1, 1, 1, 1)
    torch.testing.assert_close(direct(batch), expected + batch["seen_albedo"] * batch["direct"])


def test_a_method_without_albedo_predicts_radiance():
    one, other = (SparseDenoising(gbuffer=False, width=4, output=output) for output in ("radiance", "demodulated"))
    assert one.state_dict().keys() == other.state_dict().keys() and one.fields == other.fields
    assert one.unet.conv_out.out_channels == other.unet.conv_out.out_channels == 3


@pytest.mark.parametrize("points", [False, True])
def test_training_computes_the_photons_that_are_seen(points):
    """The same map and the same gradients as from all photons, and the network is given fewer."""
    batch = {k: v.double() if v.is_floating_point() else v for k, v in synthetic_batch().items()}
    method = NeuralLightTransport(use_points=points, use_photons=True, **SIZE).double()
    given = []
    method.photon_network.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0].numel() // 9))
    images, gradients = [], []
    for training in (True, False):
        method.train(training).zero_grad()
        images.append(method(batch))
        images[-1].square().mean().backward()
        gradients.append([parameter.grad.clone() for parameter in method.parameters()])
    torch.testing.assert_close(images[0], images[1], rtol=1e-9, atol=1e-12)
    for seen, every in zip(*gradients, strict=True):
        torch.testing.assert_close(seen, every, rtol=1e-8, atol=1e-12)
    assert 0 < given[0] < given[1] == 2 * PHOTONS


# ---- Muon -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(5, 40), (40, 5), (16, 16)])
def test_orthogonalised_matrices(shape):
    """The singular vectors stay, and the singular values come near 1."""
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    left, _, right = (torch.from_numpy(part) for part in scipy.linalg.svd(matrix.numpy(), full_matrices=False))
    values = left.T @ orthogonalize([matrix])[0] @ right.T
    assert values.diagonal().min() > 0.6 and values.diagonal().max() < 1.3
    torch.testing.assert_close(values, values.diagonal().diag(), atol=1e-3, rtol=0)


@pytest.mark.parametrize("decay", [2, 6, 12])
def test_orthogonalised_matrices_whose_singular_values_differ_by_orders_of_magnitude(decay):
    """In float32, the short iteration on products of rows is as good as the textbook's on the matrix in float64."""
    generator = torch.Generator().manual_seed(0)
    left, right = (
        torch.linalg.qr(torch.randn(size, 16, generator=generator, dtype=torch.double))[0] for size in (16, 90)
    )
    matrix = left * torch.logspace(0, -decay, 16, dtype=torch.double) @ right.T
    expected = matrix / matrix.norm()
    for _ in range(5):
        square = expected @ expected.T
        expected = 3.4445 * expected + (2.0315 * square @ square - 4.775 * square) @ expected
    assert (orthogonalize([matrix.float()])[0] - expected).norm() < 2e-3 * expected.norm()


def test_muon_is_torchs_and_adam_where_it_does_not_apply():
    """Three steps from the same gradients; PyTorch's Muon takes matrices only and computes in bfloat16."""
    generator = torch.Generator().manual_seed(0)
    weight, bias = torch.randn(6, 4, 3, 3, generator=generator), torch.randn(6, generator=generator)
    ours = [weight.clone().contiguous(memory_format=torch.channels_last), bias.clone()]
    theirs = [weight.flatten(1).clone(), bias.clone()]
    optimizer = Muon([{"params": ours[:1], "orthogonal": True}, {"params": ours[1:]}], lr=0.01)
    adam = torch.optim.Adam(theirs[1:], lr=0.01)
    muon = torch.optim.Muon(theirs[:1], lr=0.01, weight_decay=0, adjust_lr_fn="match_rms_adamw")
    for _ in range(3):
        slopes = [torch.randn(x.shape, generator=generator) for x in (weight, bias)]
        for parameters in (ours, theirs):
            for parameter, slope in zip(parameters, slopes, strict=True):
                parameter.grad = slope.view(parameter.shape).clone()
        for one in (optimizer, adam, muon):
            one.step()
    torch.testing.assert_close(ours[1], theirs[1])
    moved = (ours[0] - weight).flatten(1)
    assert (moved - (theirs[0] - weight.flatten(1))).norm() < 0.03 * moved.norm()


def test_muon_applies_to_the_matrices_of_a_method():
    """Adam keeps the last layer, the biases and the embeddings, with their own rate."""
    method = NeuralLightTransport(use_photons=True, optimizer="muon", embedding_lr=0.1, lr_schedule="paper", **SIZE)
    (optimizer,), _ = method.configure_optimizers()
    names = {id(parameter): name for name, parameter in method.named_parameters()}
    rest, matrices, embeddings = [{names[id(p)] for p in group["params"]} for group in optimizer.param_groups]
    assert matrices == {n for n, p in method.named_parameters() if p.ndim > 1} - {"unet.conv_out.weight", *embeddings}
    assert embeddings == {"embedding.table.weight"} and rest | matrices | embeddings == set(names.values())
    assert [group["lr"] for group in optimizer.param_groups] == pytest.approx([5e-4, 5e-4, 5e-5])
