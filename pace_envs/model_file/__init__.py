"""Model files as their authors wrote them: MJCF and URDF, with what they need and what they do not."""

from pace_envs.model_file.read import ModelFile, compile_model, is_model_file, read_model_file
from pace_envs.model_file.slim import leave_out_pictures, missing_files

__all__ = ["ModelFile", "compile_model", "is_model_file", "leave_out_pictures", "missing_files", "read_model_file"]
