"""`python -m bodyhull` is the command `bodyhull`."""

from bodyhull.cli import main

if __name__ == "__main__":
    main()
