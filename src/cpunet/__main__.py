"""``python -m cpunet``: the command line, for when the script is not on the path."""

from cpunet.cli import main

if __name__ == "__main__":
    main()
