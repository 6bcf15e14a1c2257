"""`python -m cpdeform` is `cpdeform`."""

from cpdeform.cli.main import main

if __name__ == "__main__":
    main()
