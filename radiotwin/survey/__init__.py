"""Fly UAVs through a truth map and bring back measurements."""

from radiotwin.survey.campaign import fly_survey
from radiotwin.survey.patterns import PATTERNS
from radiotwin.survey.statistical import segmented_truth
from radiotwin.survey.truth import read_truth

__all__ = ["PATTERNS", "fly_survey", "read_truth", "segmented_truth"]
