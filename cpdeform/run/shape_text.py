"""Shape figures as lines of text."""

from __future__ import annotations

from cpdeform.run.shape_evaluation import RestFigures, ShapeEvaluation


def shape_text(evaluation: ShapeEvaluation) -> str:
    """The figures, and how the clouds came to rest, as the lines that `cpdeform evaluate` prints."""
    figures = evaluation.figures
    share = "the start is as good as the ceiling" if figures.normalised_shape_iou is None else f"{figures.normalised_shape_iou:.4f}"
    x, y, z = figures.silhouette_iou
    lines = [
        f"  shape IoU        {figures.shape_iou_start:.4f} -> {figures.shape_iou_final:.4f}   (a sample of the goal has "
        f"{figures.shape_iou_ceiling:.4f}; normalised {share})",
        f"    silhouettes    x {x:.4f}, y {y:.4f} (from above), z {z:.4f}",
        f"    loose share    {figures.loose_share:.4f}   (beyond that of a sample of the goal)",
        f"    95% distance   {figures.distance_95_result_to_goal:.2f} cells from result to goal, "
        f"{figures.distance_95_goal_to_result:.2f} from goal to result",
    ]
    rests = {"start": evaluation.start, "result": evaluation.final, "goal": evaluation.goal}
    known = {name: found for name, found in rests.items() if found is not None}
    if not known or evaluation.goal_drop is None:
        return "\n".join([*lines, "    as they are, not at rest"])
    lines.append(
        f"    at rest        {'; '.join(_rest(name, found) for name, found in known.items())}   ({evaluation.simulator}; "
        f"the goal {evaluation.goal_drop:.4f} lower, IoU {evaluation.goal_self_iou:.4f} with itself let go)"
    )
    return "\n".join(lines)


def _rest(name: str, found: RestFigures) -> str:
    still = "" if found.rests else f", STILL MOVES {found.residual:.2g} cells a step"
    return f"{name} after {found.steps} steps{still}"
