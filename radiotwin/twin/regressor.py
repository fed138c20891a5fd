"""TwinRegressor: a twin as a scikit-learn estimator, for cross-validation and pipelines."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.links.measurements import Measurements
from radiotwin.links.plausible import LEVELS
from radiotwin.scene import Scene
from radiotwin.twin.fit import fit_twin
from radiotwin.twin.selection import AUTO


class TwinRegressor:
    """Predict levels of links from positions and devices by a twin; works without scikit-learn.

    Rows of X are links, with the columns of `Measurements(frame)`: a `device` and a position of the
    receiver. The target is the level.

    Args:
        scene: the scene, or its folder.
        devices: data frame of the devices, see `Measurements`; None: from columns of X.
        model: name of the channel model, see `fit_twin`.
        level: quantity of the target: `rssi_dbm` or `gain_db`.
        origin: origin of x and y in X, see `Measurements`.
        seed: see `fit_twin`.

    Attributes:
        twin_: the fitted twin.
    """

    _estimator_type = "regressor"

    def __init__(self, scene: Scene | Path | str | None = None,
                 devices: pd.DataFrame | None = None, model: str = AUTO,
                 level: str = "rssi_dbm", origin: Origin | None = None, seed: int = 0) -> None:
        self.scene = scene
        self.devices = devices
        self.model = model
        self.level = level
        self.origin = origin
        self.seed = seed

    def fit(self, X: pd.DataFrame, y: ArrayLike | None = None) -> Self:  # noqa: N803
        """Fit a twin.

        Args:
            X: n links.
            y: (n,) levels [dB or dBm], NaN = not detected; None: the column `level` of X.

        Raises:
            BadInput: see `Measurements` and `fit_twin`.
        """
        if self.scene is None:
            raise BadInput("a twin needs a 3D map: TwinRegressor(scene=...), a scene or its folder")
        if self.level not in LEVELS:
            raise BadInput(f"level {self.level!r} is unknown; allowed are {', '.join(LEVELS)}")
        frame = _require_frame(X)
        if y is not None:
            frame = _without_levels(frame).assign(**{self.level: np.asarray(y, dtype=float)})
        links = Measurements(frame, self.devices, self.origin)  # type: ignore[arg-type]  # None: found
        self.twin_ = fit_twin(links, self.scene, self.model, seed=self.seed)
        return self

    def predict(self, X: pd.DataFrame) -> np.ndarray:  # noqa: N803
        """Return the mean level (n,) of each row of X [dB or dBm]; levels in X are not used.

        Raises:
            BadInput: not fitted yet, X is no data frame or has no `device`, or see `Twin.predict`.
        """
        if not hasattr(self, "twin_"):
            raise BadInput("this TwinRegressor is not fitted; call fit(X, y) first")
        frame = _without_levels(_require_frame(X))
        if "device" not in frame:
            raise BadInput("column 'device' is missing: whose level is to be predicted?")
        return self.twin_.predict(frame)["mean_db"].to_numpy()

    def score(self, X: pd.DataFrame, y: ArrayLike) -> float:  # noqa: N803
        """Return the coefficient of determination R² of the detected levels y (n,) of links X."""
        level_db, predicted_db = np.asarray(y, dtype=float), self.predict(X)
        known = np.isfinite(level_db) & np.isfinite(predicted_db)
        error_db, spread_db = (level_db - predicted_db)[known], np.std(level_db[known])
        return float(1 - np.mean(error_db**2) / spread_db**2)

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return the arguments of the constructor by name, for scikit-learn's `clone`."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def set_params(self, **params: Any) -> Self:
        """Set arguments of the constructor by name.

        Raises:
            BadInput: unknown name.
        """
        for name, value in params.items():
            if name not in self.get_params():
                raise BadInput(f"TwinRegressor has no parameter {name!r}; it has "
                               f"{', '.join(self.get_params())}")
            setattr(self, name, value)
        return self

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags

        return Tags("regressor", TargetTags(required=False), regressor_tags=RegressorTags(),
                    input_tags=InputTags(two_d_array=False, string=True, allow_nan=True))

    def __repr__(self) -> str:
        return f"TwinRegressor(model={self.model!r}, level={self.level!r}, seed={self.seed})"


def _require_frame(X: Any) -> pd.DataFrame:  # noqa: N803
    """Return X; raise BadInput if it is no data frame."""
    if not isinstance(X, pd.DataFrame):
        raise BadInput(f"links are rows of a data frame with a device and a position, not "
                       f"{type(X).__name__}")
    return X


def _without_levels(frame: pd.DataFrame) -> pd.DataFrame:
    """Drop the columns of levels."""
    return frame.drop(columns=LEVELS, errors="ignore")
