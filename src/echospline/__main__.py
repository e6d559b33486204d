"""``python -m echospline`` is the command line."""

from echospline.cli import main

if __name__ == "__main__":
    main()
