"""Folders to which nobody else can write; code is loaded only from these."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def trusted(folder: Path) -> bool:
    """Whether only the user and the system administrator can put files into a folder.

    Nobody else must be able to replace the folder, either.
    """
    ours = {os.getuid(), 0} if hasattr(os, "getuid") else set()
    if not ours:  # other systems have different permissions
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
        # in a sticky folder such as /tmp, nobody can move the user's files
        if open_to_all and (place == folder or not facts.st_mode & stat.S_ISVTX):
            return False
    return True
