"""Read files, with errors that name file and key; write them completely or not at all."""

from pace_actuators.files.own_folder import OwnFolder
from pace_actuators.files.reading import checked, file_at, parsed_json, read_json, read_tensors, refuse
from pace_actuators.files.writing import (
    json_text,
    refuse_place,
    refuse_taken,
    remove_leftovers,
    replacing,
    write_atomically,
    write_json,
    write_tensors,
    write_together,
    writing,
)

__all__ = [
    "OwnFolder",
    "checked",
    "file_at",
    "json_text",
    "parsed_json",
    "read_json",
    "read_tensors",
    "refuse",
    "refuse_place",
    "refuse_taken",
    "remove_leftovers",
    "replacing",
    "write_atomically",
    "write_json",
    "write_tensors",
    "write_together",
    "writing",
]
