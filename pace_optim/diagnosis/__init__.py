"""Which physical effect is missing: search joint by joint, judge on recordings that were not fitted, advise."""

from pace_optim.diagnosis.candidates.library import candidate_effects
from pace_optim.diagnosis.diagnose import diagnose
from pace_optim.diagnosis.findings.result import Diagnosis
from pace_optim.diagnosis.method import search_effects
from pace_optim.diagnosis.settings import DiagnosisSettings

__all__ = ["Diagnosis", "DiagnosisSettings", "candidate_effects", "diagnose", "search_effects"]
