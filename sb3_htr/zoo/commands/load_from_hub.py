"""``sb3-htr load_from_hub``: rl_zoo3's command of this name, for agents of ``sb3-htr export``."""

from collections.abc import Sequence
from pathlib import Path

from sb3_htr.zoo.commands.arguments import make_parser
from sb3_htr.zoo.run.algorithm import ALGORITHMS
from sb3_htr.zoo.run.hub import model_name, pull

EXAMPLE = """  sb3-htr load_from_hub --env SparsePointRobot-v0 -orga USER
  sb3-htr enjoy --env SparsePointRobot-v0                          it lies in logs/ then, as a run does"""


def main(argv: Sequence[str]) -> None:
    """The command, with its arguments."""
    parser = make_parser("load_from_hub", "Download an agent that was uploaded with sb3-htr export --push-to-hub.", EXAMPLE)
    parser.add_argument("--env", required=True, metavar="ID", help="env of the agent")
    parser.add_argument("-orga", "--organization", required=True, metavar="USER", help="user or organization on the Hub")
    parser.add_argument("-name", "--repo-name", metavar="NAME", help="repository, by default ALGO-ID")
    algorithms = f"what trained it: {', '.join(ALGORITHMS)}, or one of your own (default: pearl)"
    parser.add_argument("--algo", default="pearl", help=algorithms)
    parser.add_argument("-f", "--folder", type=Path, default=Path("logs"), help="log folder (default: logs)")
    args = parser.parse_args(argv)
    name = args.repo_name or model_name(args.env, args.algo)
    agent = pull(f"{args.organization}/{name}", args.env, args.folder, args.algo)
    print(f"{agent.path}: to watch it, sb3-htr enjoy {agent.folder}")
