"""The sections of a page: plain data in, HTML out; every text of anybody's is made inert."""

import shlex
from typing import Any

from lmdsl.report.claims import percent
from lmdsl.report.mathematics import number
from lmdsl.report.texts import lines, table, text, words

PlainData = dict[str, Any]

SIGNS = {
    "proved": "✓", "refuted": "✗", "not proved": "○", "assumed": "!", "evidence": "≈",
    "unknown": "?",
}  # fmt: skip
STATUS = {
    "verified": ("✓", "Verified", "every claim of the certificate holds on the finite model"),
    "unverified": ("○", "Not verified", "a control law was found, but not every claim is proved"),
    "not_stabilizable": ("✗", "Not stabilizable", "it is proved that what was asked is impossible"),
    "solver_failed": ("!", "Solver failed", "the solver gave up or reached its limit"),
    "bad_input": ("!", "Bad input", ""),
}


def _known(value: Any, digits: int = 6) -> str:
    if value is None:
        return "unknown"
    if value == "inf":
        return "∞"
    return number(float(value), digits)


def heading(data: PlainData) -> str:
    """Return the title, the status in words, and the key figures."""
    result = data["result"]
    sign, word, meaning = STATUS[result["status"]]
    covered, runs = result["coverage"], result["simulation"]
    cards = []
    if result["cost"] is not None:
        bound = f"no law costs less than {_known(result['lower_bound'])}"
        cards.append(("mean cost at most", _known(result["cost"]), bound))
    if result["gap"] is not None:
        cards.append(("gap to the optimum", _known(result["gap"], 2), "relative, at most"))
    if covered is not None and covered["share"] is not None:
        count = f"{covered['stabilizable']:,} of {covered['free']:,} free cells"
        cards.append(("coverage", percent(covered["share"]), count))
    if runs is not None:
        good = runs["reached"] or runs["cycling"]
        word_ = "reach A" if runs["reached"] else "go on"
        share = percent(good / runs["starts"])
        whose = f"of {runs['starts']:,} simulated runs {word_}"
        cards.append((f"runs that {word_}", share, whose))
    if result["gamma_bar"] is not None:
        low, high = (_known(x) for x in result["gamma_bar"])
        cards.append(("largest feasible γ", low, f"at most {high}"))
    figures = "".join(
        f"<li><span>{text(name)}</span><strong>{text(value)}</strong><small>{text(more)}</small>"
        "</li>"
        for name, value, more in cards
    )
    message = str(result["message"])
    message = text(message[:1].upper() + message[1:])
    return (
        f"<header><h1>{text(data['problem']['name'] or 'A stabilization problem')}</h1>"
        f'<p class="status {text(result["status"])}"><span aria-hidden="true">{sign}</span> '
        f"<strong>{word}</strong>: {text(meaning)}.</p>"
        f"<p>{message}</p><ul class='figures'>{figures}</ul>{_checked(data)}"
        "</header>"
    )


def _checked(data: PlainData) -> str:
    """Return whether the claims were checked for this page."""
    found = data["verification"]
    if found is None:
        if data["repeat"]["fresh"]:
            return "<p class='note'>The claims were checked when the result was found.</p>"
        return (
            "<p class='note'>Claims are quoted as the saved result states them; they were not "
            "checked again for this page. <code>lmdsl verify</code> checks them.</p>"
        )
    if found["holds"]:
        said = "Checked for this page: the model was compiled anew and every claim holds."
        return f"<p class='note'>✓ {said}</p>"
    reasons = "".join(f"<li>{text(reason)}</li>" for reason in found["reasons"])
    return f"<div class='warning'><p>✗ <strong>Checked for this page, and not confirmed:</strong>" \
        f"</p><ul>{reasons}</ul></div>"  # fmt: skip


def problem(data: PlainData) -> str:
    """Return the problem in words and mathematics."""
    said = data["problem"]
    rows = (
        (text(row["name"]), " ".join([*row["math"][:1], text(row["text"])])
         if row["name"] in ("state", "control", "noise")
         else " ".join([text(row["text"]), *row["math"]]))
        for row in said["rows"]
    )  # fmt: skip
    equations = "".join(f'<div class="scroll">{x}</div>' for x in said["equations"])
    return (
        f"<p>{text(said['summary'])}</p>{equations}"
        f'<p>What is minimised, until a run enters A:</p><div class="scroll">{said["objective"]}'
        f"</div>{table(('what', 'declared as'), rows, 'declared')}"
    )


def claims(data: PlainData) -> str:
    """Return what is certified and what is not."""
    rows = [
        (f'<span class="worth {row["worth"].replace(" ", "-")}">{SIGNS[row["worth"]]} '
         f'{text(row["worth"])}</span>',
         text(row["claim"]), text(row["about"]), f"<strong>{text(row['figure'])}</strong>")
        for row in data["claims"]
    ]  # fmt: skip
    said = [reason for reason in data["reasons"] if reason != data["result"]["message"]]
    reasons = "".join(f"<li>{text(reason)}</li>" for reason in said)
    why = f"<p>Why it is not verified:</p><ul>{reasons}</ul>" if reasons else ""
    assumed = f"; it assumes that {text(data['assumes'])}" if data["assumes"] else ""
    return (
        f"{table(('worth', 'claim', 'speaks of', 'figure'), rows, 'claims')}{why}"
        f"<p>The certificate speaks of {text(data['scope'])}{assumed}. "
        "<em>Proved</em> is what was checked in arithmetic that is safe from rounding; "
        "<em>evidence</em> is what samples and simulated runs show, which is no proof.</p>"
        f"<details><summary>Words used on this page</summary><dl class='words'>{words()}</dl>"
        "</details>"
    )


def pictures(data: PlainData) -> str:
    """Return the frame of the pictures, which the script fills."""
    how = "this page runs the map as it was declared"
    if data["starts"] is None:
        how = ""
    elif data["map"] is None:
        how = "this page draws them from the rows of the finite model"
        if data["rows"] is None:
            how = ""
    elif data["map"]["kind"] == "ode":
        n = data["map"]["substeps"]
        how = f"this page makes {n} Runge-Kutta step{'s' * (n != 1)} per sampling time"
    click = f" Click, tap or press one of the buttons to start a closed-loop run: {how}." if how \
        else ""  # fmt: skip
    step = data["cells"]["step"]
    sampled = f" Of every axis one cell in {step} is drawn: the grid is large." if step > 1 else ""
    return (
        '<div id="controls" class="controls"></div><div class="side"><div id="map" class="plot" '
        'tabindex="0" role="application" aria-label="the cells of the state box: arrow keys go '
        'from cell to cell, Enter starts a run"></div>'
        '<div class="details"><h3>Cell and run</h3><div id="cell" aria-live="polite">Point at a '
        'cell.</div><div id="run" aria-live="polite"></div></div></div>'
        '<ul id="legend" class="legend"></ul>'
        f'<p class="note">Point at a cell for its value, its control and where its samples go.'
        f"{click} By keyboard: arrows and Enter.{sampled} What is drawn here is for looking at; "
        "what is proved stands above.</p>"
        '<div id="time" class="plot low" role="img" aria-label="states and controls of the last '
        'run, step by step"></div>'
    )


def closed_loop(data: PlainData) -> str:
    """Return spectrum and decay."""
    loop = data["loop"]
    if loop is None:
        return "<p>No model of the closed loop is at hand.</p>"
    radius, words = loop["radius"], []
    if radius is not None:
        least = "" if loop["complete"] else " or more"
        words.append(f"The spectral radius of the closed loop is {number(radius, 6)}{least}")
        if radius == 0:
            words.append("nothing comes back to where it was, so every run ends in finite time")
    if loop["contraction"] is not None:
        bound = loop["contraction"] / loop["growth"]
        words.append(f"the certificate proves that it is at most {number(bound, 6)}")
    if loop["mean"] is not None:
        words.append(f"a run from m takes {number(loop['mean'], 6)} steps in the mean")
    steps, left = loop["steps"], loop["left"]
    rows = []
    for share in (0.5, 0.1, 0.01, 1e-3, 1e-6):
        at = next((n for n, x in zip(steps, left, strict=True) if x <= share * left[0]), None)
        rows.append((text(f"{share:g}"), "not within the steps made" if at is None else str(at)))
    return (
        f"<p>{text('; '.join(words))}. On {loop['cells']:,} cells with {loop['transitions']:,} "
        "transitions.</p>"
        '<div class="side even"><div id="spectrum" class="plot" role="img" '
        'aria-label="eigenvalues in the unit circle"></div>'
        '<div id="decay" class="plot" role="img" aria-label="share of runs not yet in A"></div>'
        f"</div>{table(('share of the mass still on its way', 'after steps'), rows)}"
    )


def simulation(data: PlainData) -> str:
    """Return the evidence of runs."""
    runs = data["result"]["simulation"]
    if runs is None:
        return "<p>There are no runs: there is no control law, or the map is not at hand.</p>"
    rows = [("runs", f"{runs['starts']:,}"), ("reached A", f"{runs['reached']:,}"),
            ("lost", f"{runs['lost']:,}{_losses(runs)}"),
            ("neither, within the step limit", f"{runs['cycling']:,}")]  # fmt: skip
    if runs["steps"]:
        for key, name in (("min", "fewest"), ("q50", "median"), ("q90", "90 %"), ("q99", "99 %"),
                          ("max", "most")):  # fmt: skip
            rows.append((f"steps to A, {name}", f"{runs['steps'][key]:,}"))
    if runs["cost"]:
        mean, error = runs["cost"]["mean"], runs["cost"]["standard_error"]
        spread = "" if error is None else f" ± {number(error, 2)}"
        certified = data["result"]["cost"]
        beside = "" if certified is None else f" (certified on the model: {_known(certified)})"
        rows.append(("mean cost", f"{number(mean)}{spread}{beside}"))
    if runs["held"]:
        held = runs["held"]
        what = (
            f"{held['stayed']:,} stayed, {held['returned']:,} left and came back, "
            f"{held['lost']:,} were lost"
        )
        rows.append((f"then, {held['steps']:,} more steps in A", what))
    how = f"<p>Followed: {text(runs['method'])}.</p>" if runs["method"] else ""
    return how + table(("what", "figure"), ((text(a), text(b)) for a, b in rows))


def _losses(runs: PlainData) -> str:
    words = {"outside": "left the box", "avoid": "in Z", "no_control": "without control"}
    parts = [f"{n:,} {words[key]}" for key, n in runs["lost_to"].items() if n]
    return f" ({', '.join(parts)})" if parts else ""


def lost(data: PlainData) -> str:
    """Return what cannot be stabilized, by region and cause."""
    found = data["lost"]
    if not found:
        return "<p>Every cell outside A and Z can be stabilized.</p>"
    parts = []
    for cause in found:
        rows = [
            (f"{region['cells']:,}", text(region["box"]), text(region["why"]))
            for region in cause["regions"]
        ]
        if cause["elsewhere"]:
            rows.append((f"{cause['elsewhere']:,}", "elsewhere", ""))
        known = 3 if any(why for *_, why in rows) else 2
        head = ("cells", "where", "what stops the middle one")[:known]
        meaning = cause["meaning"][:1].upper() + cause["meaning"][1:]
        parts.append(
            f"<h3>{text(cause['name'])}: {cause['cells']:,} cells</h3><p>{text(meaning)}.</p>"
            f"{table(head, [row[:known] for row in rows])}"
        )
    return "".join(parts) + "<p><code>lmdsl explain</code> says what would help.</p>"


def comparison(data: PlainData) -> str:
    """Return the backends that were compared."""
    compared = data["comparison"]
    rows = [
        (text(one["backend"]), text(one["status"]), _known(one["cost"], 10),
         _known(one["lower_bound"], 10), _known(one["gap"], 2), text(one["polish_steps"]),
         _known(one["seconds"]["solve"], 3))
        for one in compared["results"]
    ]  # fmt: skip
    head = ("backend", "status", "cost at most", "lower bound", "gap", "polished", "seconds")
    agreed = compared["agreement"]
    note = "" if agreed is None else (
        f"<p>Costs agree within {number(agreed['cost'], 2)}, values within "
        f"{number(agreed['value'], 2)}; {percent(agreed['controls'])} of the controls are equal "
        "or as good.</p>"
    )  # fmt: skip
    return table(head, rows) + note


def proof(data: PlainData) -> str:
    """Return what is proved of the true map."""
    return f"<pre>{lines(data['proof'])}</pre><p>The pictures above show it by cell.</p>"


def repeat(data: PlainData) -> str:
    """Return how to get the same again."""
    again = data["repeat"]
    folder = shlex.quote(again["directory"] or "out")
    solve = f"lmdsl solve problem.json --backend {shlex.quote(str(again['backend']))}"
    if again["proved"] is not None:
        solve += f" --proved {again['proved']!r}"
    commands = [f"{solve} --out {folder}", f"lmdsl verify {folder}",
                f"lmdsl simulate {folder} --starts 1000 --seed {again['seed']}"]  # fmt: skip
    if again["proof"] is not None:
        commands.append(f"lmdsl prove {folder}{again['proof']}")
    commands.append(f"lmdsl report {folder}")
    versions = "; ".join(f"{name} {version}" for name, version in again["versions"].items())
    before = "; ".join(f"{name} {version}" for name, version in again["made_by"].items())
    made = f"The result was found with {text(before)}. " if before else ""
    file = data["problem"]["file"]
    held = "<p>The problem is no file, or a long one; it is not part of this page.</p>"
    if file is not None:
        held = f"<details><summary>problem.json</summary><pre>{lines(file)}</pre></details>"
    digest = f"<p>Compiled model: SHA-256 <code>{text(again['digest'])}</code></p>"
    notes = "".join(f"<li>{text(note)}</li>" for note in data["notes"])
    left = f"<p>Left out of this page:</p><ul>{notes}</ul>" if notes else ""
    spent = data["result"]["seconds"]
    stages = {"compile": "compiling", "solve": "solving", "verify": "checking"}
    took = [f"{word} took {spent[k]:.3g} s" for k, word in stages.items() if spent[k] is not None]
    made += f"{'; '.join(took).capitalize()}. " if took else ""
    return (
        f"<pre>{lines(chr(10).join(commands))}</pre>{held}{digest if again['digest'] else ''}"
        f"<p>{made}This page was written with {text(versions)}; seed {again['seed']}.</p>{left}"
    )
