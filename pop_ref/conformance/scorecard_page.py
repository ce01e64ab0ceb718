"""The scorecard as a page that needs nothing else: counts by stage, what is broken where, and why laws were skipped."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pop_ref.conformance.scorecard import Entry, Scorecard


def page(card: Scorecard, made_with: Mapping[str, str]) -> str:
    """Return the page."""
    made = ", ".join(f"{name} {value}" for name, value in made_with.items())
    parts = [_HEAD.format(title=escape(card.title)), f"<p class=made>{escape(made)}</p>"]
    for backend, stages in card.summary().items():
        chosen = [entry for entry in card.entries if entry.backend == backend]
        parts += [f"<section><h2>{escape(backend)}</h2>", _verdict(chosen)]
        parts += [_surface(card.surfaces.get(backend, {})), _table(stages)]
        parts += [*_broken(chosen), *_pairs(card.pairs.get(backend, {})), *_skipped(chosen), "</section>"]
    return "\n".join(parts)


def _count(entries: list[Entry], outcome: str) -> int:
    return sum(entry.outcome == outcome for entry in entries)


def _verdict(entries: list[Entry]) -> str:
    passed, crashed, skipped = (_count(entries, outcome) for outcome in ("passed", "crashed", "skipped"))
    failed = _count(entries, "failed") + crashed
    if not passed + failed:
        return "<p>Nothing could be judged.</p>"
    words = f"breaks {failed} of {passed + failed} laws" if failed else f"obeys all {passed} laws that could be tried"
    words += f", {crashed} of them by errors of its own" if crashed else ""
    return f"<p class={'bad' if failed else 'good'}>{words}; {skipped} skipped</p>"


def _surface(surface: dict[str, Any]) -> str:
    if not surface:
        return ""
    lines = [f"Constants: {surface['profile']}; precision: {surface['dtype']}."]
    for group in ("whole views", "arguments", "stage functions"):
        offered, lacks = surface[group]["offered"], surface[group]["not"]
        lines.append(f"Reached of {group}: {len(offered)} of {len(offered) + len(lacks)}.")
        lines += [f"Not reached: {', '.join(lacks)}."] if lacks else []
    return "<p class=made>" + "<br>".join(map(escape, lines)) + "</p>"


def _table(stages: dict[str, dict[str, int]]) -> str:
    rows = []
    for stage, count in stages.items():
        judged = count["passed"] + count["failed"]
        kind = "bad" if count["failed"] else "good" if judged else "none"
        share = 100.0 * count["passed"] / judged if judged else 0.0
        bar = f'<span class=bar><i style="width:{share:.0f}%"></i></span>' if judged else ""
        cells = (f"{count['passed']} of {judged}" if judged else "–", count["failed"] or "", count["skipped"] or "")
        rows.append(f"<tr class={kind}><th>{stage}<td>{bar}" + "".join(f"<td class=n>{cell}" for cell in cells))
    head = "<tr><th>stage<th><th class=n>obeyed<th class=n>broken<th class=n>skipped"
    return f"<table>{head}{''.join(rows)}</table>"


def _broken(entries: list[Entry]) -> list[str]:
    failed = [entry for entry in entries if entry.outcome in ("failed", "crashed")]
    parts = ["<h3>Broken</h3>"] if failed else []
    for entry in failed:
        lines = "".join(f"<li>{escape(line)}" for line in entry.differences)
        parts.append(
            f"<article><b>{_sentence(entry.law)}</b> <small>{entry.stage}, {entry.outcome}</small>"
            f"<p>{escape(entry.detail)}</p><ul>{lines}</ul></article>"
        )
    return parts


def _pairs(pairs: dict[str, Any]) -> list[str]:
    if not pairs:
        return []
    head = f"Pairs of arguments compared: {pairs['judged']} of {pairs['taken']}, in {pairs['calls']} calls"
    rows = [f"<dt>refused alone: {escape(what)}<dd>{escape(why)}" for what, why in pairs["refused alone"].items()]
    rows += [f"<dt>not compared, as every call with them fails<dd>{escape(pair)}" for pair in
             pairs["only in calls that fail"]]  # fmt: skip
    rows += [f"<dt>{escape(names)}<dd>{count}" for names, count in pairs["by arguments"].items()]
    return [f"<details><summary>{head}</summary><dl>{''.join(rows)}</dl></details>"]


def _skipped(entries: list[Entry]) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for entry in entries:
        if entry.outcome == "skipped":
            by_reason.setdefault(entry.detail, []).append(_sentence(entry.law))
    if not by_reason:
        return []
    rows = [
        f"<dt>{escape(reason)}<dd>{'; '.join(laws)}"
        for reason, laws in sorted(by_reason.items(), key=lambda each: -len(each[1]))
    ]
    total = sum(len(laws) for laws in by_reason.values())
    return [f"<details><summary>Skipped: {total}</summary><dl>{''.join(rows)}</dl></details>"]


def _sentence(law: str) -> str:
    return escape(law.replace("_", " "))


_HEAD = """<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content="width=device-width">
<title>{title}</title><style>
:root{{color-scheme:light dark;--ink:#1f2328;--quiet:#6b7280;--line:#d8dce2;--good:#2f8f6b;--bad:#c2403a;--paper:#fff}}
@media(prefers-color-scheme:dark){{:root{{--ink:#e4e7eb;--quiet:#98a1ad;--line:#3a414b;--paper:#16191d}}}}
body{{font:16px/1.5 system-ui,sans-serif;max-width:56rem;margin:2rem auto;padding:0 1rem;
color:var(--ink);background:var(--paper)}}
h1{{font-size:1.4rem;margin-bottom:0}} h2{{font-size:1.15rem;margin:2.2rem 0 .2rem}}
h3{{font-size:1rem;margin-bottom:.3rem}}
.made,small,dd{{color:var(--quiet);font-size:.85rem}} .made{{margin-top:.2rem}}
p.good{{color:var(--good)}} p.bad{{color:var(--bad)}} p.good,p.bad{{font-weight:600;margin:.2rem 0 .6rem}}
table{{border-collapse:collapse}} th{{font-weight:400;text-align:left}} tr:first-child th{{color:var(--quiet)}}
td,th{{padding:.18rem .8rem .18rem 0;border-bottom:1px solid var(--line)}} .n{{text-align:right;min-width:4.5rem}}
.none th,.none td{{color:var(--quiet)}} .bad .n:nth-child(4){{color:var(--bad);font-weight:600}}
.bar{{display:inline-block;width:9rem;height:.55rem;background:var(--bad);border-radius:2px;overflow:hidden}}
.bar i{{display:block;height:100%;background:var(--good)}}
article{{border-left:3px solid var(--bad);padding:.1rem 0 .1rem .8rem;margin:.7rem 0}}
article p,article li{{font:.82rem/1.45 ui-monospace,monospace;overflow-wrap:anywhere;margin:.2rem 0}}
article ul{{padding-left:1.1rem;margin:.2rem 0}} details{{margin-top:1rem}}
dt{{margin-top:.5rem}} dd{{margin-left:1rem}}
</style><h1>{title}</h1>"""
