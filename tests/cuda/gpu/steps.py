"""Ten steps of training: fused ones on a device, and the same on the CPU by what `pop train` takes there."""

from __future__ import annotations

import torch

from .scene import HEIGHT, LR, STEPS, WIDTH, TrainingScene

# share of the image that a blurred Gaussian dominates
THETA = 0.02


def fused_trainer(scene: TrainingScene, device, masks=None, **options):
    """Return rows (parameters and moments) and the trainer of them."""
    from cuda_ext.training.resident import ResidentViews
    from cuda_ext.training.train_step import FusedTrainer
    from pop_fast.train.schedule import steady_updates
    from pop_fast.train.steps import StepSettings

    params = {name: value.to(device).clone() for name, value in scene.params.items()}
    m, v = ({name: torch.zeros_like(value) for name, value in params.items()} for _ in range(2))
    views = ResidentViews(scene.photographs, scene.viewmats, scene.Ks, masks, "valid", device)
    settings = StepSettings(steady_updates(LR, STEPS), **options)
    return (params, m, v), FusedTrainer(params, m, v, views, scene.order, settings)


def fused(scene: TrainingScene, device, window: bool = False, **options):
    """Take the steps of one phase; return objectives, parameters and the trainer."""
    from pop_fast.train.steps import Phase

    (params, _, _), trainer = fused_trainer(scene, device, **options)
    losses = []
    for step in range(STEPS):
        trainer.run(step + 1, Phase(3, True, True, True, window=window))
        losses.append(float(trainer.values[2]))
    return losses, params, trainer


def on_the_cpu(scene: TrainingScene, **readings):
    """Take the steps with the strategy that `pop train` takes, its statistics collected and nothing grown.

    Returns:
        Losses, POP terms, parameters and the strategy's state.
    """
    from pop_fast.api.rasterize import rasterization
    from pop_fast.density import POPStrategy
    from pop_fast.stages.losses import photometric_pop

    strategy = POPStrategy(refine_start_iter=STEPS, blur_start_iter=0, theta_blur=THETA, **readings)
    params = {name: value.clone().requires_grad_() for name, value in scene.params.items()}
    optimizer = torch.optim.Adam([{"params": [params[name]], "lr": LR[name]} for name in params], eps=1e-15)
    state, losses, terms = strategy.initialize_state(), [], []
    for step in range(STEPS):
        view = scene.order[step]
        opacities = torch.sigmoid(params["opacities"])
        image, _, meta = rasterization(
            params["means"], params["quats"], params["scales"].exp(), opacities,
            torch.cat((params["sh0"], params["shN"]), 1), scene.viewmats[view][None], scene.Ks[view][None],
            WIDTH, HEIGHT, sh_degree=3, packed=False, dominance=True,
        )  # fmt: skip
        loss = photometric_pop(image[0], scene.photographs[view].float() / 255.0)
        term = strategy.regularizer(opacities, state, step, meta)
        assert term is not None
        losses.append(loss.item())
        terms.append(term.item())
        strategy.step_pre_backward(params, {}, state, step, meta)
        (loss + term).backward()
        optimizer.step()
        optimizer.zero_grad()
        strategy.step_post_backward(params, {}, state, step, meta)
    return losses, terms, {name: value.detach() for name, value in params.items()}, state


def apart(found, wanted, name) -> float:
    """Return the share of entries that differ by a tenth of all steps together.

    Where a gradient is rounding, Adam turns its sign into a whole step: what nearly all rows do is compared.
    """
    return float(((found.cpu() - wanted).abs() > 0.1 * LR[name] * STEPS).float().mean())
