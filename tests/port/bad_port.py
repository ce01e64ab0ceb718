"""A program that answers the kit's protocol and then misbehaves, in the way that its first argument names."""

import struct
import sys
import time

CALLED = {
    "call shapeless": "ok value",
    "call negative": "ok value=[-1]",
    "call huge": "ok value=[65536,65536]",
    "call twice": "ok value=[] value=[]",
    "call wide": "ok value=[2]",
    "call nothing": "ok",
    "call draws": "draw 3",
    "call refuses": "error not today",
}
HELLO = "ok name=bad dtype=float32 profile=paper offers=image,T_final,dominant_ids"
GREETINGS = {
    "nameless": "ok dtype=float32 profile=paper offers=image,T_final",
    "half": "ok name=bad dtype=float16 profile=paper offers=image,T_final",
    "striped": "ok name=bad dtype=float32 profile=paper sh_degree=4 offers=image,T_final",
    "elsewhere": "ok name=bad dtype=float32 profile=mine offers=image,T_final",
    "stranger": "ok name=bad dtype=float32 profile=paper offers=image,T_final,colour",
    "lonely": "ok name=bad dtype=float32 profile=paper offers=image",
    "silent": "",
}


def write(line: str, *numbers: float) -> None:
    sys.stdout.buffer.write(line.encode() + b"\n" + struct.pack(f"<{len(numbers)}d", *numbers))
    sys.stdout.buffer.flush()


def main(mode: str) -> None:
    while line := sys.stdin.buffer.readline().decode():
        verb, *words = line.split()
        if verb == "hello":
            write(GREETINGS.get(mode, f"{HELLO},l2,densify_and_prune" if mode.startswith(("call", "draw")) else HELLO))
            continue
        if verb == "call":
            # what a call brings with it: two pictures of two by two pixels, or nothing
            sys.stdin.buffer.read(8 * 24 if words[0] == "l2" else 0)
            if mode == "call ends":
                sys.exit(4)
            write(CALLED.get(mode, mode), *([0.0] * {"call wide": 2}.get(mode, 0)))
            continue
        given = dict(word.split("=") for word in words)
        n, n_sh, pixels = int(given["N"]), int(given["n_sh"]), int(given["width"]) * int(given["height"])
        sys.stdin.buffer.read(8 * (11 * n + 3 * n_sh * n + 16 + 9 + 3))
        image, T, ids = [0.0] * 3 * pixels, [1.0] * pixels, [-1.0] * pixels
        if mode == "ends":
            sys.exit("out of memory, says the port")
        if mode == "hangs":
            time.sleep(1000)
        if mode == "has no end":
            sys.stdout.buffer.write(b"ok" * 50000)
            sys.stdout.buffer.flush()
            continue
        whole = "ok image T_final dominant_ids"
        answers = {
            "refuses": ("error harmonics are not for me",),
            "babbles": ("image follows", *image),
            "stops halfway": (whole, *image[1:]),
            "forgets": ("ok image", *image),
            "invents": (f"{whole} colour", *image, *T, *ids, *image),
            "splits": (whole, *image, *T, *[0.5] * pixels),
            "says more": (whole, *image, *T, *ids, 0.0),
        }
        write(*answers.get(mode, (whole, *image, *T, *ids)))
        if mode == "stops halfway":
            sys.exit(3)


main(" ".join(sys.argv[1:]))
