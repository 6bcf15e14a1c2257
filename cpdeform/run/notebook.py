"""How a result shows itself in a notebook."""

from __future__ import annotations

import base64
import html
import io
from typing import Any

from cpdeform.planning.result import DeformResult

WIDTH = 300
"""Width of each picture, pixels."""


def result_html(result: DeformResult) -> str:
    """Start, result and goal as pictures, and losses and metric as a table.

    Without the packages that draw there is the table alone.
    """
    metric = result.metric_name.replace("_", " ")
    rows = [
        ("loss", f"{result.loss_initial:.4g} → {result.loss_final:.4g}"),
        (metric, f"{result.metric_initial:.4g} → {result.metric_value:.4g}"),
        ("status", result.status.value.replace("_", " ")),
        ("stages", str(len(result.stages))),
        ("gradient evaluations", str(result.gradient_evaluations)),
        ("seconds", f"{result.seconds:.1f}"),
    ]
    table = "".join(
        f"<tr><th style='text-align:left'>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows
    )
    advice = f"<p>{html.escape(result.status.advice)}</p>" if result.status.advice else ""
    return f"<h4>{html.escape(result.task.name)}</h4>{_pictures(result)}<table>{table}</table>{advice}"


def _pictures(result: DeformResult) -> str:
    try:
        # Through the public face: drawing is above this layer, and may not be installed.
        from PIL import Image

        from cpdeform import render

        states: dict[str, Any] = {"start": result.stages[0].state_before, "result": result.state, "goal": result.goal}
        figures = []
        for name, state in states.items():
            buffer = io.BytesIO()
            Image.fromarray(render(state, scene=result.task.scene, width=WIDTH)).save(buffer, format="png")
            data = base64.b64encode(buffer.getvalue()).decode("ascii")
            figures.append(f"<figure style='display:inline-block;margin:4px'><img src='data:image/png;base64,{data}' alt='{name}'>")
            figures.append(f"<figcaption>{name}</figcaption></figure>")
        return f"<div>{''.join(figures)}</div>"
    except ModuleNotFoundError:
        return ""
