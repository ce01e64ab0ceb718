"""A program in any language as a backend: laws make scenes, the program answers over its standard input and output.

The kit starts the program once and sends one request after the other; the program ends when its input does. A request
is a line of words in ASCII, `verb key=value ...`, and then arrays, little-endian float64 in C order with nothing
between. An answer is a line, `ok ...` or `error TEXT`, and then the arrays that it names, in the same form; what is
written to standard error is shown where the program fails.

    hello protocol=1
        -> ok name=NAME dtype=float32|float64 profile=PROFILE offers=WORD,WORD,...
           and sh_degree=0|1|2 where harmonics end before the third degree
    render N= n_sh= width= height= tile_size= sh_degree= antialiased=0|1 CONSTANTS want=NAME,NAME,...
    and means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, n_sh, 3], viewmat [4, 4], K [3, 3],
    background [3]
        -> ok NAME NAME ... and these arrays; at least those that are wanted
    gradients, the same, and v_image [H, W, 3], v_T_final [H, W]
        -> ok v_NAME v_NAME ... and these arrays
    call FUNCTION NAME=VALUE ... and the arrays among the values
        -> draw NUMBER, where a value is `draw`: the program goes on with NUMBER=[SHAPE], a line, and the array
        -> ok NAME=[SHAPE] ... and these arrays

PROFILE is one of `pop_ref.PROFILES`, whose constants every scene then has, or `any`, and CONSTANTS are the fields of
`Profile` with 0 and 1 for false and true. Offered are arrays, by the names of `SHAPES` (integers cross as float64,
too), and what `ABILITIES` lists. `image` and `T_final` belong together, as do `v_means`, `v_quats`, `v_scales`,
`v_opacities` and `v_sh`. What is not offered is skipped by name; an answer that is malformed, late or missing breaks
the law that asked, and the program is started again for the next one.

Functions that may be offered, and are then called by their names:

- every function of the oracle whose values cross (`program_values` says how they are written): losses and their
  gradients, density control, Adam, single stages. Arguments have the oracle's names; the result is `value`, with a dot
  and the field, key or place for each of its parts. Normal deviates of a split are asked for with `draw`.
- `rasterization`, with gsplat's arguments: several cameras, batch dimensions, modes of depth, plain colours, clipping.
  It answers `images` and `alphas`, and what it likes of gsplat's meta. With `rasterization_vjp` it is pulled back: the
  same arguments, `v_images` and `v_alphas` give `v_` and the name of each array that has a gradient; `v_viewmats` and
  `v_backgrounds` may be left out. A program that offers it need not offer `image` or `v_means`. An argument that a
  program does not have it refuses, in these words: `error batch dimensions are not supported`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import os
import queue
import shlex
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from typing import IO, Any, Final

import numpy as np

from pop_ref.conformance import capabilities
from pop_ref.conformance.adapter import Adapter, View
from pop_ref.conformance.calls import Call, Called, Frame
from pop_ref.conformance.program_values import decoded, encoded, line_of, shape_of, signature_of
from pop_ref.conformance.scenes import Scene, scene_arrays
from pop_ref.constants import PROFILES, profile_named

PROTOCOL: Final = 1
# what a render may answer, and its shape in the letters of the protocol
OF_A_VIEW: Final = {
    "image": "H W 3",
    "T_final": "H W",
    "dominant_ids": "H W",
    "dominant_weights": "H W",
    "dominant_counts": "N",
    "n_blended": "H W",
    "n_traversed": "H W",
    "radii": "N 2",
    "means2d": "N 2",
    "depths": "N",
    "conics": "N 3",
}
OF_GRADIENTS: Final = {
    "v_means": "N 3",
    "v_quats": "N 4",
    "v_scales": "N 3",
    "v_opacities": "N",
    "v_sh": "N n_sh 3",
    "v_viewmat": "4 4",
    "v_background": "3",
    "v_means2d": "N 2",
    "v_means2d_abs": "N 2",
}
SHAPES: Final = {**OF_A_VIEW, **OF_GRADIENTS}
INTEGERS: Final = frozenset({"dominant_ids", "dominant_counts", "n_blended", "n_traversed", "radii"})
ABILITIES: Final = {
    "antialiased": capabilities.ANTIALIASING,
    "deterministic": capabilities.DETERMINISTIC,
    "rowwise": capabilities.ROWWISE,
    "thousands": capabilities.SCALE,
}
RASTERIZATION: Final = ("rasterization", "rasterization_vjp")
_TOGETHER: Final = (("image", "T_final"), ("v_means", "v_quats", "v_scales", "v_opacities", "v_sh"))


class ProgramAdapter(Adapter):
    """A program that answers the protocol of this module.

    Args:
        command: the program and its arguments, as a shell splits them.
        timeout: seconds that an answer may take.

    Raises:
        ProgramError: it cannot be started, or does not greet as it must.
    """

    def __init__(self, command: str, timeout: float = 60.0) -> None:
        self._pipe = Pipe(shlex.split(command), timeout)
        words = self._greeting()
        self.name = words["name"]
        self.dtype = {"float32": np.float32, "float64": np.float64}[words["dtype"]]
        self.profile = None if words["profile"] == "any" else profile_named(words["profile"])
        self.sh_degree = int(words.get("sh_degree", 3))
        self.offers = tuple(words["offers"].split(","))
        self.able = tuple(ABILITIES[word] for word in self.offers if word in ABILITIES)
        for name in self.offers:
            # an array and a function of one name: the array was meant
            if name not in SHAPES and signature_of(name) is not None:
                setattr(self, name, functools.partial(self._stage, name))
        if "rasterization" in self.offers:
            self.call = self._rasterize

    def _greeting(self) -> dict[str, str]:
        answer = self._pipe.ask(f"hello protocol={PROTOCOL}")
        words: dict[str, str] = {}
        for word in answer.split():
            key, _, words[key] = word.partition("=")
        expected = "name=NAME dtype=float32|float64 profile=PROFILE offers=WORD,..."
        wrong = [key for key in ("name", "dtype", "profile", "offers") if not words.get(key)]
        if wrong:
            raise ProgramError(f"{self._pipe} greets with 'ok {answer}', without {wrong[0]}; it must say ok {expected}")
        allowed = {"dtype": ("float32", "float64"), "profile": (*PROFILES, "any"), "sh_degree": ("0", "1", "2", "3")}
        for key, values in allowed.items():
            if words.get(key, values[-1]) not in values:
                raise ProgramError(
                    f"{self._pipe} greets with {key}={words[key]}; it must be one of {', '.join(values)}"
                )
        offers = words["offers"].split(",")
        words_known = (*SHAPES, *ABILITIES, *RASTERIZATION)
        unknown = [word for word in offers if word not in words_known and signature_of(word) is None]
        if unknown:
            known = ", ".join(words_known) + " and functions of the oracle whose values cross"
            raise ProgramError(f"{self._pipe} offers {unknown[0]!r}; what may be offered is {known}")
        for group in _TOGETHER:
            lacks = [name for name in group if name not in offers]
            if lacks and len(lacks) < len(group):
                raise ProgramError(f"{self._pipe} offers no {lacks[0]}; {', '.join(group)} belong together")
        return words

    def has(self, need: str) -> bool:
        """Tell whether the program offers it."""
        known = {
            capabilities.RENDER: ("image", "rasterization"),
            capabilities.GRADIENTS: ("v_means", "rasterization_vjp"),
            capabilities.DOMINANCE: ("dominant_ids",),
            capabilities.DOMINANT_WEIGHTS: ("dominant_weights",),
            capabilities.DOMINANT_COUNTS: ("dominant_counts",),
        }
        if need == capabilities.SCALE:
            return capabilities.SCALE in self.able
        return any(word in self.offers for word in known[need]) if need in known else super().has(need)

    def render(self, scene: Scene) -> View:
        """Draw a scene and ask for everything that is offered."""
        return self._view(scene, [name for name in OF_A_VIEW if name in self.offers])

    def plainly(self, scene: Scene) -> View:
        """Draw a scene and ask for nothing but the image."""
        return self._view(scene, ["image", "T_final"])

    def _view(self, scene: Scene, wanted: list[str]) -> View:
        if "image" in self.offers:
            return View(**self._ask("render", scene, wanted))
        called = self._rasterize(Call(((Frame(scene),),)))
        return View(image=called.images[0, 0], T_final=1.0 - called.alphas[0, 0])

    def gradients(self, scene: Scene, v_image: Any, v_T_final: Any) -> dict[str, np.ndarray]:
        """Ask for the cotangents that are offered."""
        if "v_means" in self.offers:
            wanted = [name for name in OF_GRADIENTS if name in self.offers]
            found = self._ask("gradients", scene, wanted, v_image, v_T_final)
            return {name.removeprefix("v_"): value for name, value in found.items()}
        v_images, v_alphas = np.asarray(v_image)[None, None], -np.asarray(v_T_final)[None, None]
        found = self._rasterize(Call(((Frame(scene),),)), v_images, v_alphas).gradients
        of_camera = {"colors": "sh", "viewmats": "viewmat", "backgrounds": "background"}
        return {of_camera.get(name, name): value[0] if name in ("viewmats", "backgrounds") else value
                for name, value in found.items()}  # fmt: skip

    def takes(self, argument: str) -> bool:
        """Tell whether a call may say how it is computed: every program is told the side of tiles."""
        return argument in ("tile_size", "dominance")

    def _stage(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """Call a stage function of the program."""
        found = signature_of(name)
        assert found is not None
        signature, kind = found
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        arrays = self._called(name, [word for key, each in bound.arguments.items() for word in encoded(each, key)])
        try:
            return decoded(kind, arrays, "value")
        except (KeyError, ValueError, IndexError) as error:
            what = f"lacks {error.args[0]}" if isinstance(error, KeyError) else str(error)
            raise ProgramError(f"{self._pipe} answers {name} with {', '.join(arrays) or 'nothing'}: {what}") from error

    def _called(self, name: str, words: list[tuple[str, Any]]) -> dict[str, np.ndarray]:
        """Send a call and return the arrays of its answer by name."""
        draws = [value for _, value in words if callable(value)]
        arrays = [value for _, value in words if isinstance(value, np.ndarray)]
        answer = self._pipe.ask(f"call {name} {line_of(words)}", arrays, draws[0] if draws else None)
        shapes: dict[str, tuple[int, ...]] = {}
        try:
            for word in answer.split():
                key, _, shape = word.partition("=")
                if key in shapes:
                    raise ValueError(f"{key} is there twice")
                shapes[key] = shape_of(shape)
        except ValueError as error:
            self._pipe.stop()
            raise ProgramError(f"{self._pipe} answers {name} with 'ok {answer[:200]}': {error}") from error
        found = {key: self._pipe.read_array(key, shape) for key, shape in shapes.items()}
        self._pipe.done()
        return found

    def _rasterize(self, call: Call, v_images: Any = None, v_alphas: Any = None) -> Called:
        """Make a call with gsplat's arguments, and pull cotangents back where the program can.

        Raises:
            NotImplementedError: rows are to be packed, which is a way to hand over memory.
        """
        if call.packed or call.sparse_grad:
            raise NotImplementedError("a program answers rows of all Gaussians; packed rows do not cross")
        (B, C, _), camera = call.shape, call.first.scene.camera
        given = {
            **call.tensors(),
            "Ks": call.intrinsics(),
            "width": camera.width,
            "height": camera.height,
            "sh_degree": call.sh_degree,
            "render_mode": call.render_mode,
            "rasterize_mode": "antialiased" if call.antialiased else "classic",
            "radius_clip": call.radius_clip,
            "tile_size": call.tile_size,
            "profile": dataclasses.replace(call.profile, tile_size=call.tile_size),
        }
        words = [word for name, value in given.items() for word in encoded(value, name)]
        found = self._called("rasterization", words)
        images, alphas = (self._held(found, name, "rasterization") for name in ("images", "alphas"))
        gradients: dict[str, np.ndarray] = {}
        if v_images is not None and "rasterization_vjp" in self.offers:
            v = {"v_images": np.asarray(v_images), "v_alphas": np.asarray(v_alphas)}
            words += [(name, call.batched(value)) for name, value in v.items()]
            gradients = self._pulled(call, words)
        shape = (B, C, camera.height, camera.width)
        try:
            images, alphas = images.reshape(*shape, call.n_channels), alphas.reshape(shape)
        except ValueError:
            raise ProgramError(f"{self._pipe} answers images {list(images.shape)} and alphas {list(alphas.shape)}; "
                               f"they must be {[*shape, call.n_channels]} and {list(shape)}") from None  # fmt: skip
        whole = {name: value.astype(np.int64) if name in INTEGERS else value for name, value in found.items()}
        return Called(images, alphas, whole, gradients)

    def _pulled(self, call: Call, words: list[tuple[str, Any]]) -> dict[str, np.ndarray]:
        """Return the gradients of a call's arrays; those of cameras and backgrounds a program need not have."""
        found = {name.removeprefix("v_"): value for name, value in self._called("rasterization_vjp", words).items()}
        own = call.tensors().keys()
        lacks, strange = sorted(own - {"viewmats", "backgrounds"} - found.keys()), sorted(found.keys() - own)
        if lacks or strange:
            what = f"without v_{lacks[0]}" if lacks else f"where v_{strange[0]} is the gradient of no argument"
            answer = ", ".join(f"v_{name}" for name in found) or "nothing"
            raise ProgramError(f"{self._pipe} answers rasterization_vjp with {answer}, {what}")
        return found

    def _held(self, found: dict[str, np.ndarray], name: str, function: str) -> np.ndarray:
        if name not in found:
            raise ProgramError(f"{self._pipe} answers {function} with {', '.join(found) or 'nothing'}, without {name}")
        return found[name]

    def _ask(self, verb: str, scene: Scene, wanted: list[str], *cotangents: Any) -> dict[str, np.ndarray]:
        n, n_sh, _ = scene.gaussians.sh.shape
        words = {
            "N": n,
            "n_sh": n_sh,
            "width": scene.camera.width,
            "height": scene.camera.height,
            "tile_size": scene.side,
            "sh_degree": scene.degree,
            "antialiased": int(scene.antialiased),
        }
        constants = {k: v for k, v in dataclasses.asdict(scene.profile).items() if k not in ("name", "tile_size")}
        words |= {key: int(value) if isinstance(value, bool) else value for key, value in constants.items()}
        line = " ".join((verb, *(f"{key}={value}" for key, value in words.items()), f"want={','.join(wanted)}"))
        answer = self._pipe.ask(line, [*scene_arrays(scene).values(), *cotangents])
        return self._arrays(answer.split(), wanted, OF_A_VIEW if verb == "render" else OF_GRADIENTS, words)

    def _arrays(
        self, names: list[str], wanted: list[str], known: dict[str, str], words: dict[str, Any]
    ) -> dict[str, np.ndarray]:
        sizes = {"N": words["N"], "n_sh": words["n_sh"], "H": words["height"], "W": words["width"]}
        strange = [name for name in names if name not in known or names.count(name) > 1]
        lacks = [name for name in wanted if name not in names]
        if strange or lacks:
            what = f"names {strange[0]!r}, unknown or twice" if strange else f"lacks {lacks[0]}, which was asked for"
            self._pipe.stop()
            raise ProgramError(f"{self._pipe} answers 'ok {' '.join(names)}', which {what}")
        found: dict[str, np.ndarray] = {}
        for name in names:
            shape = tuple(int(sizes.get(axis, axis)) for axis in known[name].split())
            value = self._pipe.read_array(name, shape)
            if name in INTEGERS:
                whole = np.where(np.isfinite(value), value, 0.5)
                if np.any(whole != np.round(whole)):
                    self._pipe.stop()
                    raise ProgramError(f"{self._pipe} answers {name} that are not whole numbers")
                value = whole.astype(np.int64)
            if name in wanted:
                found[name] = value
        self._pipe.done()
        return found


# the longest line of an answer, and how much of what a failing program wrote to standard error is shown, bytes
LONGEST_LINE: Final = 1 << 16
SHOWN: Final = 2000
MOST_DRAWN: Final = 10**6
_CHUNK: Final = 1 << 16


class ProgramError(RuntimeError):
    """The program broke the protocol: it ended, took too long, or answered what cannot be read."""


class Pipe:
    """A program that is started when it is first asked, and again after it has failed.

    Args:
        command: the program and its arguments.
        timeout: seconds from a request to the end of its answer. Once it has passed, later answers may take a second,
            or five times as long as the slowest sound one: a law that shrinks a scene asks many times.
    """

    def __init__(self, command: list[str], timeout: float) -> None:
        self.command = command
        self.timeout = timeout
        self._slowest = 0.0
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self._chunks: queue.Queue[bytes] = queue.Queue()
        self._buffer = bytearray()
        self._asked, self._asked_at, self._limit = "", 0.0, timeout

    def __str__(self) -> str:
        return f"program {' '.join(self.command)}"

    def ask(self, line: str, arrays: list[Any] | None = None, draw: Callable[[int], Any] | None = None) -> str:
        """Send a request and return its answer's line without the leading ok; arrays are read with `read_array`.

        Args:
            line: the request.
            arrays: that follow it.
            draw: answers a line `draw NUMBER` that may come before the program's own answer.

        Raises:
            ProgramError: there is no such line in time.
        """
        self._start()
        self.nothing_left()
        self._asked, self._asked_at = " ".join(line.split()[: 2 if line.startswith("call ") else 1]), time.monotonic()
        self._send(line, arrays or [])
        answer = self._line()
        if draw is not None and answer.startswith("draw "):
            number = answer.removeprefix("draw ")
            if not number.isdecimal() or int(number) > MOST_DRAWN:
                raise self._failed(f"answers {answer[:80]!r}; it must be draw and a whole number up to {MOST_DRAWN}")
            drawn = np.asarray(draw(int(number)), dtype=np.float64)
            self._send(f"{number}=[{','.join(map(str, drawn.shape))}]", [drawn])
            answer = self._line()
        first, _, words = answer.partition(" ")
        if first == "error":
            self.done()
            raise ProgramError(f"{self} refuses the request {self._asked}: {words}")
        if first != "ok":
            raise self._failed(f"answers {answer[:80]!r}, which begins neither with ok nor with error")
        return words

    def _send(self, line: str, arrays: list[Any]) -> None:
        body = b"".join(np.ascontiguousarray(a, dtype="<f8").tobytes() for a in arrays)
        # at the same time as the reading, because a program may begin to answer before it has read everything
        threading.Thread(target=_write, args=(self._process, line.encode() + b"\n" + body), daemon=True).start()

    def _line(self) -> str:
        while b"\n" not in self._buffer:
            if len(self._buffer) > LONGEST_LINE:
                raise self._failed(f"begins its answer with {len(self._buffer)} bytes that hold no line")
            self._receive("a line")
        text, _, rest = bytes(self._buffer).partition(b"\n")
        self._buffer = bytearray(rest)
        return text.decode("utf-8", "backslashreplace").strip()

    def read_array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Read an array of the answer."""
        size = 8 * int(np.prod(shape))
        while len(self._buffer) < size:
            self._receive(f"the {size} bytes of {name} {list(shape)}")
        value = np.frombuffer(bytes(self._buffer[:size]), dtype="<f8").reshape(shape)
        del self._buffer[:size]
        return value

    def nothing_left(self) -> None:
        """Make sure that the program has written nothing that it was not asked for, as far as it is here."""
        while not self._chunks.empty():
            self._buffer += self._chunks.get_nowait()
        if self._buffer:
            raise self._failed(f"writes {len(self._buffer)} bytes more than its answer announces")

    def done(self) -> None:
        """Say that an answer has been read, and make sure that it holds no more than it announced."""
        self._slowest = max(self._slowest, time.monotonic() - self._asked_at)
        self.nothing_left()

    def stop(self) -> None:
        """End the program; the next request starts it again."""
        if self._process is not None:
            _end(self._process)
            self._process = None

    def _start(self) -> None:
        if self._process is not None:
            return
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the program
        try:
            self._process = subprocess.Popen(
                self.command, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said
            )
        except OSError as error:
            raise ProgramError(f"{self} cannot be started: {error}") from error
        weakref.finalize(self, _end, self._process)
        self._chunks, self._buffer = queue.Queue(), bytearray()
        threading.Thread(target=_read, args=(self._process, self._chunks), daemon=True).start()

    def _receive(self, what: str) -> None:
        left = self._asked_at + self._limit - time.monotonic()
        try:
            chunk = self._chunks.get(timeout=max(left, 0.0))
        except queue.Empty:
            limit, self._limit = self._limit, min(self._limit, max(1.0, 5.0 * self._slowest))
            raise self._failed(f"took longer than {limit:.3g} s to answer {self._asked}, waiting for {what}") from None
        if not chunk:
            raise self._failed(f"ended{self._status()} before it had answered {self._asked}, waiting for {what}")
        self._buffer += chunk

    def _status(self) -> str:
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            return f" with status {self._process.wait(timeout=1.0)}"
        return ""

    def _failed(self, what: str) -> ProgramError:
        self.stop()
        return ProgramError(f"{self} {what}{self._last_words()}")

    def _last_words(self) -> str:
        if self._said is None:
            return ""
        self._said.seek(0, os.SEEK_END)
        self._said.seek(max(0, self._said.tell() - SHOWN))
        words = self._said.read().decode("utf-8", "backslashreplace").strip()
        return f"; it wrote to standard error: {words}" if words else ""


def _write(process: subprocess.Popen[bytes], request: bytes) -> None:
    # the reader notices a program that has ended
    with contextlib.suppress(OSError, ValueError):
        assert process.stdin is not None
        left = memoryview(request)
        while left:
            left = left[process.stdin.write(left) :]


def _read(process: subprocess.Popen[bytes], chunks: queue.Queue[bytes]) -> None:
    assert process.stdout is not None
    with contextlib.suppress(OSError, ValueError):
        while chunk := os.read(process.stdout.fileno(), _CHUNK):
            chunks.put(chunk)
    chunks.put(b"")
    process.stdout.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()
    # the reader closes the other end
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()
