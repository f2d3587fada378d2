"""``python -m cpunet``: the command line, where the folder of scripts is not on the path."""

from cpunet.cli.main import main

if __name__ == "__main__":
    main()
