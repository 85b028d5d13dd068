"""Which physical effect is missing: adequacy, location, ranking, verification, verdict."""

from motorid.diagnosis.adequacy import adequacy
from motorid.diagnosis.diagnose import diagnose
from motorid.diagnosis.improve import improve
from motorid.diagnosis.locate import locate
from motorid.diagnosis.results import Adequacy, Binned, Candidate, Diagnosis, Ladder, Missing, Rung
from motorid.diagnosis.suggest import Suggestion, suggest_experiment

__all__ = [
    "Adequacy",
    "Binned",
    "Candidate",
    "Diagnosis",
    "Ladder",
    "Missing",
    "Rung",
    "Suggestion",
    "adequacy",
    "diagnose",
    "improve",
    "locate",
    "suggest_experiment",
]
