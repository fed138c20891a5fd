"""Say which model predicts best, and whether a plain one would do."""

from __future__ import annotations

from typing import Any

AS_GOOD = 1.02  # ratio of errors up to which one model is as good as another

# Of the models that are fitted; all others are published laws.
_WORDS = {"log_distance": "the log-distance law", "segmented_log_distance": "the segmented law",
          "regression_kriging": "kriging", "extra_trees": "a tree ensemble (ExtraTrees)",
          "hist_gradient_boosting": "gradient boosting (HistGradientBoosting)"}


def compare_with_baselines(error: dict[str, Any],
                           baselines: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Return how good the combination is beside the best other model; None without any error.

    Args:
        error: scores of `combined` and of `after`, each with `rmse_db` [dB].
        baselines: scores of other models by name.

    Returns:
        `best_baseline`, `best_baseline_rmse_db`, `combined_rmse_db`, and `advice`, a sentence.
    """
    rmse_db = {name: each["rmse_db"] for name, each in baselines.items()
               if each["n"] == error["combined"]["n"]}
    combined_db = error["combined"]["rmse_db"]
    if not rmse_db or not error["combined"]["n"]:
        return None
    best = min(rmse_db, key=lambda name: rmse_db[name])
    words, best_db = _WORDS.get(best, best), rmse_db[best]
    if best_db <= AS_GOOD * combined_db:
        plain = "a plain regression" if best in _WORDS else "a published law"
        advice = (f"For prediction alone {plain} would do: {words} {best_db:.2f} dB, "
                  f"all that was learnt together {combined_db:.2f} dB.")
    else:
        gain = 100 * (1 - combined_db / best_db)
        advice = (f"All that was learnt together predicts to {combined_db:.2f} dB, {gain:.0f} % "
                  f"better than the best other model ({words} alone: {best_db:.2f} dB).")
    after_db = error["after"]["rmse_db"]
    if after_db is not None and after_db > AS_GOOD * best_db:
        advice += f" The base with all that was found is behind {words}: {after_db:.2f} dB."
    return {"best_baseline": best, "best_baseline_rmse_db": best_db,
            "combined_rmse_db": combined_db, "advice": advice}
