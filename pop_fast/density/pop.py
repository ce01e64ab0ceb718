"""POP: growth by gradient or by blur, the Polarized Opacity Prior, and no opacity reset."""

from __future__ import annotations

from dataclasses import dataclass

from pop_fast.density.control import DensityControl


@dataclass(frozen=True, kw_only=True)
class POPStrategy(DensityControl):
    """Density control of the POP paper, with the reading of every open question as a setting.

    A Gaussian grows when its screen gradient is large (as in gsplat) or, from `blur_start_iter` to `blur_stop_iter`,
    when it is the dominant Gaussian of more than `theta_blur * H * W` pixels of a view. Opacities are never reset.
    Instead `regularizer` adds `lambda_pop * L_pop` to the loss, which pushes the opacities of Gaussians that dominate a
    pixel to 1 and the others to 0. A trainer other than ours adds that term itself, where there is one:

        state = strategy.initialize_state(scene_scale)
        for step, (viewmat, K, photograph) in enumerate(views):
            opacities = torch.sigmoid(params["opacities"])
            image, _, info = rasterization(
                params["means"], params["quats"], params["scales"].exp(), opacities,
                torch.cat((params["sh0"], params["shN"]), dim=1), viewmat[None], K[None], width, height,
                sh_degree=3, packed=False,
            )
            strategy.step_pre_backward(params, optimizers, state, step, info)
            loss = (image[0] - photograph).abs().mean()
            prior = strategy.regularizer(opacities, state, step, info)
            if prior is not None:
                loss = loss + prior
            loss.backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            strategy.step_post_backward(params, optimizers, state, step, info, packed=False)

    The defaults are those of `pop_ref.settings`; with `reset_every=3000, prune_too_big=True, lambda_pop=0.0` it is the
    paper's row "Reset".
    """
