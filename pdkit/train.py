"""`pdkit train`: base policies from demonstrations, and decorated ones over several seeds with the evidence recorded."""
from __future__ import annotations

from .cli import Parser
from .methods import METHODS
from .policies import POLICIES
from .profiles import PROFILES
from .torch_setup import set_threads
from .train_base import train_base
from .train_decorated import train_decorated


def main(argv: list[str]) -> int:
    parser = Parser(prog="pdkit train", description="Train a base policy, or decorate one.")
    kinds = parser.add_subparsers(dest="kind", required=True, parser_class=Parser)
    base = kinds.add_parser("base", help="imitate demonstrations")
    base.add_argument("task")
    base.add_argument("--profile", default="lesson", help="lesson (the defaults: minutes on a CPU) or paper (the official code's "
                                                         "settings, for bet and diffusion: days)")
    base.add_argument("--policy", default="bet", help=f"one of: {', '.join(POLICIES)}")
    base.add_argument("--demos", help="demonstration file (default: the bundled one)")
    base.add_argument("--num-demos", type=int, help="use only the first so many")
    base.add_argument("--out", help="folder of the checkpoint (default runs/base/TASK-POLICY)")
    base.add_argument("--pixels", action="store_true", help="see pictures instead of the object's state: train an encoder with the policy")
    base.add_argument("--device", default="auto", help="where it is trained: auto (CUDA where there is one), cpu or cuda")
    base.add_argument("--episodes", type=int, default=0, help="test episodes, told in its policy.json (default: none)")
    decorated = kinds.add_parser("decorated", help="improve a base policy by online RL on sparse reward, by any of the methods")
    decorated.add_argument("task")
    decorated.add_argument("--profile", default="lesson", help=f"one of: {', '.join(PROFILES)}")
    decorated.add_argument("--method", default="policy_decorator", help=f"one of: {', '.join(METHODS)}")
    decorated.add_argument("--base", help="folder of the base policy (default: the shipped one that the method starts from)")
    decorated.add_argument("--demos", help="demonstration file (default: the bundled one)")
    decorated.add_argument("--num-demos", type=int, help="use only the first so many (default: as many as the base policy saw)")
    decorated.add_argument("--seeds", type=int, nargs="+", default=[0])
    decorated.add_argument("--episodes", type=int, default=200, help="test episodes (default 200)")
    decorated.add_argument("--out", help="folder of the runs (default runs/train)")
    decorated.add_argument("--record", help="name under data/results: rows are added to NAME.csv and NAME_curves.csv")
    decorated.add_argument("--recipe", help="what to call this configuration in the record, and the run's folder (default: the profile's "
                                            "name, or the method's)")
    decorated.add_argument("--pixels", action="store_true", help="start from the shipped visual policy (--base may name another)")
    decorated.add_argument("--tensorboard", action="store_true", help="also write event files to the folder of each run")
    for one in (base, decorated):
        one.add_argument("--threads", type=int, default=1)
        one.add_argument("--set", metavar="NAME=VALUE", nargs="+", action="extend", default=[], help="change a field of the configuration")
    args = parser.parse_args(argv)
    set_threads(args.threads)
    return (train_base if args.kind == "base" else train_decorated)(args)
