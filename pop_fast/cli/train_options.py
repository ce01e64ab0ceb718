"""The options of `pop train` on blocks, and which settings the words of its command line name."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

import tyro

from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.presets import ALIASES, METHODS, PRESETS


@dataclass(frozen=True, kw_only=True)
class BlocksOptions:
    """How a capture is divided.

    Attributes:
        blocks: divide the ground of a capture that is larger than memory, as 2x2, into strips and parts of them; each
            block is trained by itself, and the blocks are merged.
        blocks_margin: what a block is trained on beyond its core, as a share of the core's size.
        blocks_share: a view from elsewhere trains a block whose core holds at least this share of the points in its
            picture.
        blocks_rounds: how often the merged blocks are trained on: each round trains what a block has in its core among
            all others as they are, and merges again. With --resume a finished run takes further rounds. (default: 2)
        blocks_round_steps: steps of a block in a round. (default: a tenth of --max-steps)
        blocks_jobs: how many blocks are trained at a time on the CPU of this machine; GPUs train one each. More than
            one needs Snakemake.
        blocks_profile: hand the blocks to a cluster by this Snakemake profile: slurm, or a folder of yours.
    """

    blocks: str | None = None
    blocks_margin: float = 0.2
    blocks_share: float = 0.25
    blocks_rounds: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    blocks_round_steps: Annotated[int | None, tyro.conf.arg(help_behavior_hint="")] = None
    blocks_jobs: int = 1
    blocks_profile: str | None = None


# what decides the defaults of all other settings
PLAN: Final = ("method", "preset", "steps_scaler", "scale_lambda_pop")


# words of other trainers' command lines: Inria's, gsplat's
_ALIASES: Final = {
    **dict.fromkeys(("-s", "--source-path", "--data-dir", "--data"), "DATA"),
    **dict.fromkeys(("-m", "--model-path", "--result-dir", "-o"), "--out"),
    "--data-factor": "--factor",
    "--iterations": "--max-steps",
}
_SMALLER: Final = (
    "--factor 2 (4, 8) trains on photographs shrunk by so much; --sfm.max-size is only how large they are while "
    "cameras are searched for"
)
# of which the nearest option by its letters is another thing
_ELSEWHERE: Final = dict.fromkeys(("--max-size", "--resolution", "-r", "--downscale", "--downscale-factor"), _SMALLER)
_IGNORED: Final = frozenset({"--eval"})  # Inria: hold out every 8th view; here the default (--test-every 0 holds none)


def rename_aliases(argv: Sequence[str]) -> list[str]:
    """Turn options of Inria's and gsplat's trainers into ours: `-s DIR` into `DIR`, `-m DIR` into `--out DIR`, ..."""
    words: list[str] = []
    rest = list(argv)
    while rest:
        word = rest.pop(0)
        if not word.startswith("-"):
            # a path may hold "="
            words.append(word)
            continue
        word = word.replace("--adc.", "--gsplat.", 1) if word.startswith("--adc.") else word
        name, equals, value = word.partition("=")
        name = name.replace("_", "-") if name.startswith("--") else name
        if name in _ELSEWHERE:
            raise PopError(f"{name} is no option of pop train; {_ELSEWHERE[name]}")
        target = _ALIASES.get(name)
        if name in _IGNORED:
            continue
        if target == "DATA":
            words += [value] if equals else []
        else:
            words += [target or name, value] if equals else [target or word]
    return words


def plan_of(words: Sequence[str]) -> dict[str, Any]:
    """Find what decides the defaults; a value that cannot be is left out, for the parser of all words to refuse."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("method", "preset", "steps-scaler"):
        parser.add_argument(f"--{name}", nargs="?")
    parser.add_argument("--scale-lambda-pop", action="store_true")
    found = parser.parse_known_args([_dashed(word) for word in words if word != "--"])[0]
    plan: dict[str, Any] = {"scale_lambda_pop": found.scale_lambda_pop}
    plan |= {"method": found.method} if found.method in (*METHODS, *ALIASES) else {}
    plan |= {"preset": found.preset} if found.preset in PRESETS else {}
    with contextlib.suppress(TypeError, ValueError):
        plan["steps_scaler"] = float(found.steps_scaler)
    return plan


def overrides(args: Any, base: TrainConfig, words: Sequence[str]) -> dict[str, Any]:
    """Return the settings that the words name, also where what they say is the default.

    Args:
        args: what the words were parsed into, with the attributes of `base`.
        base: the defaults.
        words: the words.

    Returns:
        Values by dotted name, as `TrainConfig.of` takes them.
    """
    named = {_dashed(word).partition("=")[0].removeprefix("--") for word in words if word.startswith("--")}
    found: dict[str, Any] = {}
    for name, value, default in _settings(args, base):
        group, dot, last = {"result_dir": "out"}.get(name, name).replace("_", "-").rpartition(".")
        if value != default or named & {f"{group}{dot}{last}", f"{group}{dot}no-{last}"}:
            found[name] = value
    return found


def _settings(args: Any, base: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
    """Give every setting's dotted name, its value and its default."""
    for field in dataclasses.fields(TrainConfig):
        if field.name == "given":
            continue
        value, default = getattr(args, field.name), getattr(base, field.name)
        group = base.method if field.name == "strategy" else field.name
        if not dataclasses.is_dataclass(value):
            yield group, value, default
            continue
        for inner in dataclasses.fields(value):
            yield f"{group}.{inner.name}", getattr(value, inner.name), getattr(default, inner.name)


def _dashed(word: str) -> str:
    """Spell an option's name with dashes, as tyro takes both spellings."""
    name, equals, value = word.partition("=")
    return (name.replace("_", "-") if name.startswith("--") else name) + equals + value
