"""Folders to which nobody else can write: only from these may code be loaded."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def trusted(folder: Path) -> bool:
    """Whether only the user, and the system's administrator, can put files into a folder.

    Nobody else may be able to put another one in its place, either.
    """
    ours = {os.getuid(), 0} if hasattr(os, "getuid") else set()
    if not ours:  # other systems have other rules
        return True
    folder = folder.resolve()
    for place in (folder, *folder.parents):
        try:
            facts = place.stat()
        except OSError:
            return False
        open_to_all = facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if facts.st_uid not in ours:
            return False
        # in a sticky folder, as /tmp, nobody can move what belongs to us
        if open_to_all and (place == folder or not facts.st_mode & stat.S_ISVTX):
            return False
    return True
