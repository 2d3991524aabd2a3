"""The command line, as the command `bathynerf` and as ``python -m bathynerf``."""

import sys

from bathynerf._packages import ForeignPackage, require_packages

_BAD_INSTALLATION = 2


def main() -> None:
    """Run the verb named by the arguments, or say which other package is in the way."""
    try:
        require_packages()
    except ForeignPackage as error:
        sys.stderr.write(f"error: {error}\n")
        sys.exit(_BAD_INSTALLATION)
    from survey.commands.app import main as run

    run()


if __name__ == "__main__":
    main()
