"""`python -m unirender`: the same as the command."""

from unirender.cli import main

if __name__ == "__main__":
    main()
