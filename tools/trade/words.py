"""What a result says in words."""

from __future__ import annotations

NAMES = {
    "time_median_us": "median time",
    "time_p95_us": "95 % time",
    "wrong": "missed and extra",
    "voxel": "voxel grid",
}


def convergence_line(result: dict, size: str = "full") -> str:
    """Return one sentence on how far the reference can be trusted."""
    levels = result["sizes"][size]["levels"]
    last = levels[-1]
    samples = f"{last['scale']}x{last['scale']} samples a pixel"
    what = f"{samples}, {last['max_px']:g} px between frames ({last['frames']} frames)"
    if more := result.get("reference_set"):
        what += f", with {', '.join(more)}"
    if not last["ratio"]:
        return f"the reference, {what}, was NOT checked: there was time for only one level"
    moved = ", ".join(f"{NAMES[k]} {100 * v:.2g} %" for k, v in last["ratio"].items())
    verdict = (
        "converged"
        if result["sizes"][size]["converged"]
        else f"did NOT converge to a tenth ({100 * result['enough']:.0f} %) within the limits"
    )
    return f"the reference {verdict}: {what}; change from the level before, relative to the smallest error: {moved}"
