"""The command ``sb3-htr``."""

import importlib
import sys
from collections.abc import Sequence

COMMANDS = {
    "train": "meta-train an agent, with rl_zoo3's arguments and YAML files",
    "evaluate": "adapt a trained agent to unseen tasks; prints a table and draws two pictures",
}
USAGE = "usage: sb3-htr COMMAND [ARGUMENTS]; sb3-htr COMMAND --help explains the arguments.\n\n" + "\n".join(
    f"  {name:<10} {text}" for name, text in COMMANDS.items()
)


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: arguments, by default those of the process
    :return: exit status: 0, or 2 for arguments that cannot be understood
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    if not arguments or arguments[0] not in COMMANDS:
        print(USAGE, file=sys.stderr)
        return 2
    command, *rest = arguments
    try:
        module = importlib.import_module(f"sb3_htr.zoo.{command}")
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("sb3_htr"):
            raise
        print(f"sb3-htr needs {error.name}, which is not installed: pip install 'sb3_htr[zoo]'", file=sys.stderr)
        return 1
    module.main(rest)
    return 0


if __name__ == "__main__":
    sys.exit(main())
