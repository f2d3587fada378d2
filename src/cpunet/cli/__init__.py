"""The command line."""

from cpunet.cli.environment import sound_environment

sound_environment()  # before a library that reads it is loaded
