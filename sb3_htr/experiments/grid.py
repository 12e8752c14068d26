"""Every experiment: which methods, on which env, for how long, with how many seeds."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from sb3_htr.common.settings import check_numbers
from sb3_htr.experiments import figures
from sb3_htr.experiments.ablations import ABLATIONS
from sb3_htr.experiments.cell import Cell, Evaluation, KwArgs
from sb3_htr.experiments.tuned import TUNED_DENSE, TUNED_HFR, TUNED_HIPI, TUNED_RL2
from sb3_htr.zoo.run.agents import WRAPPERS
from sb3_htr.zoo.run.method import get_method
from sb3_htr.zoo.run.shipped import block_of

# What another argument says, with which a setting would be left out or contradicted in silence
NO_SETTINGS = {
    "method": "as the first argument",
    "n_timesteps": "to the Experiment, and budget, the times of it, to the Variant",
    "env_kwargs": "as env_kwargs=",
}
EXPLORERS = ("belief", "learned-prior", "aggregate", "prior")
BELIEF = ("belief",)


def by(explorers: tuple[str, ...], *places: KwArgs) -> tuple[Evaluation, ...]:
    """
    :param explorers: names
    :param places: arguments of the env that are other than in training; none are by default
    :return: evaluations by each explorer in each of these envs
    """
    return tuple(Evaluation(explorer, place) for place in places or ({},) for explorer in explorers)


@dataclass(frozen=True, eq=False)
class Variant:
    """
    One line of a table: a method, and what differs from its settings.

    :param method: name in hyperparams/methods.yml
    :param name: in tables and folders, that of the method by default
    :param settings: hyperparameters, joined with those of env and method
    :param env_kwargs: arguments of the env
    :param budget: times the env steps of the experiment
    :raises ValueError: for wrappers among the settings, or for what is no setting
    """

    method: str
    name: str = ""
    settings: KwArgs = field(default_factory=dict)
    env_kwargs: KwArgs = field(default_factory=dict)
    budget: float = 1.0

    def __post_init__(self) -> None:
        if wrappers := [name for name in WRAPPERS if name in self.settings]:
            raise ValueError(
                f"An experiment has no {wrappers[0]}, as its final models are evaluated in the env of its id: register the "
                "wrapped env under an id of its own."
            )
        if not isinstance(self.name, str):
            raise ValueError(f"The name of a Variant is {self.name!r}, expected a text: Variant(method, name, settings).")
        if elsewhere := sorted(NO_SETTINGS.keys() & self.settings.keys()):
            raise ValueError(f"{elsewhere[0]} is no setting of a Variant: give it {NO_SETTINGS[elsewhere[0]]}.")


@dataclass(frozen=True, eq=False)
class Experiment:
    """
    :param name: of commands and folders
    :param about: one sentence
    :param env_id: registered env
    :param n_timesteps: env steps of a run
    :param variants: what is compared; the first is what the others are compared with
    :param seeds: runs of each variant
    :param eval_freq: env steps between evaluations on the validation tasks
    :param evaluations: what is done with the final models
    :param models_of: name of the experiment whose runs are tested; by default it trains its own
    :param figure: draws the results of all cells into a file, the picture that has the experiment's name
    :param also: draw pictures with their own names
    :param n_episodes: adaptation episodes on a task, in training's evaluations and in those of the final models
    :raises ValueError: for numbers that are none or too small, without evaluations, or for a figure that is no function
    """

    name: str
    about: str
    env_id: str
    n_timesteps: int
    variants: tuple[Variant, ...]
    seeds: int = 5
    eval_freq: int = 10_000
    evaluations: tuple[Evaluation, ...] = by(EXPLORERS)
    models_of: str = ""
    figure: figures.Figure = figures.learning
    also: tuple[figures.Figure, ...] = (figures.reliability,)
    n_episodes: int = 20

    def __post_init__(self) -> None:
        check_numbers(
            n_timesteps=(self.n_timesteps, 1.0),
            seeds=(self.seeds, 1),
            eval_freq=(self.eval_freq, 1),
            n_episodes=(self.n_episodes, 1),
        )
        if not self.evaluations:
            raise ValueError(
                f"The experiment {self.name} has no evaluations, of which its table is: leave them out, or name one."
            )
        for figure in (self.figure, *self.also):
            if not callable(figure):
                raise ValueError(
                    f"A figure of the experiment {self.name} is {figure!r}, expected a function, as figures.learning."
                )

    def cells(self, seeds: int | None = None, scale: float = 1.0) -> list[Cell]:
        """
        :param seeds: runs of each variant, as many as the experiment asks for by default
        :param scale: times its env steps
        :return: the runs, seed by seed
        :raises ValueError: if two would be in one folder
        """
        cells = [
            Cell(
                experiment=self.name,
                models_of=self.models_of or self.name,
                env_id=self.env_id,
                method=variant.method,
                variant=variant.name or variant.method,
                seed=seed,
                n_timesteps=int(self.n_timesteps * variant.budget * scale),
                eval_freq=max(int(self.eval_freq * scale), 1),
                n_episodes=self.n_episodes,
                settings=variant.settings,
                env_kwargs=variant.env_kwargs,
                evaluations=self._evaluations_of(variant.method),
            )
            for seed in range(1, (seeds or self.seeds) + 1)
            for variant in self.variants
        ]
        twice = [name for name, n in Counter(cell.name for cell in cells).items() if n > 1]
        if twice:
            raise ValueError(
                f"Several runs of {self.name} would be in the folder {twice[0]}: give the variants names that differ in "
                "letters or digits."
            )
        return cells

    def _evaluations_of(self, method: str) -> tuple[Evaluation, ...]:
        """Of its final models; one that explores in a way of its own is evaluated once in each env."""
        result: list[Evaluation] = []
        for evaluation in self.evaluations:
            evaluation = evaluation._replace(explorer=get_method(method).explorer_for(evaluation.explorer))
            if evaluation not in result:
                result.append(evaluation)
        return tuple(result)


POINT, SPEED, WHEELED, ANT = "SparsePointRobot-v0", "SparseTargetSpeed-v0", "SparseWheeled-v0", "SparseAnt-v0"
FETCH = "HiddenFetchReach-v0"


# The Point Robot's goals: as in training, nearer, and further away
DISTANCES: tuple[KwArgs, ...] = ({}, {"goal_distance": 0.8}, {"goal_distance": 1.2}, {"goal_distance": 1.4})
UNDER_PRIOR = by(("prior", "prior, 10 exploration episodes", "belief"))
# Robots take long to simulate: the default, PEARL's protocol with either prior; and the default further away
OF_ROBOTS = (*by(("belief", "learned-prior", "prior")), *by(BELIEF, {"goal_distance": 2.5}))


def replay(**settings: Any) -> dict[str, Any]:
    """
    :param settings: of the replay buffer
    :return: hyperparameters
    """
    return {"replay_buffer_kwargs": settings}


def settings_of(file: str, env_id: str = "default") -> KwArgs:
    """
    :param file: name of a YAML file of the package
    :param env_id: registered env; by default any that has no block of its own in it
    :return: what it says, but for what an experiment and its methods say themselves
    """
    return {key: value for key, value in block_of(file, env_id).items() if key not in ("policy", "n_timesteps")}


def under_prior(env_id: str = "default", end: str = "-prior") -> tuple[Variant, ...]:
    """
    :param env_id: as for :func:`settings_of`
    :param end: of the methods' names: whether `prior` explores in rollouts, too
    :return: HTR, and PEARL with a dense and a sparse reward, with the settings that are made for PEARL's own protocol
    """
    settings = settings_of("pearl_prior.yml", env_id)
    return tuple(Variant(method + end, settings=settings) for method in ("htr-ser", "pearl-dense", "pearl-sparse"))


# PEARL's methods on robots; the budgets of the two others are those of their YAML files
ON_ROBOTS = tuple(map(Variant, ("htr-ser", "pearl-dense", "pearl-sparse", "htr-hfr", "htr-hipi")))

ALL = (
    Experiment(
        "point_robot",
        "HTR by both kinds of relabelling, against PEARL without relabelling and with a dense proxy reward.",
        POINT,
        150_000,
        (
            *map(Variant, ("htr-ser", "htr-ec", "pearl-dense", "pearl-sparse", "pearl-sparse-prior")),
            # Nothing is rewarded under other tasks for what PEARL's own protocol acts by
            Variant("pearl-sparse-prior", "pearl-sparse-prior, reward_coef 0", {"reward_coef": 0.0}),
        ),
        evaluations=by(EXPLORERS, *DISTANCES),
    ),
    # What cannot be interpolated: training tasks avoid 40 degrees of the semicircle, in which all test tasks lie
    Experiment(
        "held_out_sector",
        "Goals in a sector that training tasks avoid.",
        POINT,
        150_000,
        tuple(Variant(method, env_kwargs={"held_out": [70.0, 110.0]}) for method in ("htr-ser", "pearl-dense")),
    ),
    Experiment(
        "paper_profile",
        "The settings of the papers, and their protocol: with relabelling, and with a dense reward, as PEARL was published.",
        POINT,
        1_000_000,
        tuple(Variant(method, settings=settings_of("pearl_paper.yml")) for method in ("htr-ser-prior", "pearl-dense-prior")),
        eval_freq=50_000,
        evaluations=by(("prior", "learned-prior", "belief")),
    ),
    Experiment(
        "prior",
        "PEARL's own protocol, in rollouts and at meta-test, with settings made for it: HTR, and no relabelling.",
        POINT,
        150_000,
        under_prior(),
        evaluations=UNDER_PRIOR,
    ),
    Experiment(
        "wheeled_prior",
        "The same on a robot with wheels.",
        WHEELED,
        300_000,
        under_prior(WHEELED),
        eval_freq=100_000,
        evaluations=UNDER_PRIOR,
    ),
    Experiment(
        "ant_prior",
        "PEARL's own protocol at meta-test, on an ant, with settings made for it: HTR, and no relabelling.",
        ANT,
        300_000,
        under_prior(ANT, end=""),
        eval_freq=100_000,
        evaluations=by(("prior", "belief")),
    ),
    Experiment(
        "learned_prior",
        "PEARL's protocol, in rollouts and at meta-test, with a prior that is learned.",
        POINT,
        150_000,
        (Variant("htr-ser", "htr-ser, learned prior", dict.fromkeys(("explorer", "train_explorer"), "learned-prior")),),
        evaluations=by(("learned-prior", "belief"), {}, {"goal_distance": 0.8}, {"goal_distance": 1.2}),
    ),
    Experiment(
        "ablation",
        "The default explorer without one of its parts, with the same models.",
        POINT,
        150_000,
        (Variant("htr-ser"),),
        evaluations=by((*BELIEF, *ABLATIONS, "aggregate"), *DISTANCES),
        models_of="point_robot",
        figure=figures.evaluations,
    ),
    Experiment(
        "ant_ablation",
        "What is left of adaptation without inference, with models of an ant.",
        ANT,
        600_000,
        (Variant("htr-ser"),),
        eval_freq=100_000,
        evaluations=by((*BELIEF, "training tasks in turn")),
        models_of="ant",
        figure=figures.evaluations,
    ),
    Experiment(
        "wheeled",
        "HTR on a robot with wheels, against other rewards, other ways to relabel and to adapt, and one that is told more.",
        WHEELED,
        600_000,
        (*ON_ROBOTS, Variant("rl2", budget=2.5), Variant("sac-her", budget=0.5)),
        eval_freq=50_000,
        evaluations=OF_ROBOTS,
        also=(figures.reliability, figures.race),
    ),
    Experiment(
        "ant",
        "HTR on a robot with legs, against other rewards, other ways to relabel and to adapt, and one that is told more.",
        ANT,
        600_000,
        (*ON_ROBOTS, Variant("rl2", budget=2.5), Variant("sac-her")),
        eval_freq=100_000,
        evaluations=OF_ROBOTS,
        also=(figures.reliability, figures.race),
    ),
    Experiment(
        "target_speed",
        "Tasks that are no places: both kinds of relabelling against PEARL with sparse and with dense rewards.",
        SPEED,
        60_000,
        tuple(map(Variant, ("htr-ser", "htr-ec", "pearl-dense", "pearl-sparse"))),
    ),
    Experiment(
        "fetch_reach",
        "An arm of gymnasium-robotics, its goal hidden: HTR, and PEARL without relabelling.",
        FETCH,
        150_000,
        tuple(map(Variant, ("htr-ser", "pearl-sparse"))),
        eval_freq=75_000,
        evaluations=by(BELIEF),
    ),
    Experiment(
        "fetch_push",
        "An arm that pushes a block to a place which it is not told: HTR, and PEARL without relabelling.",
        "HiddenFetchPush-v0",
        1_000_000,
        tuple(map(Variant, ("htr-ser", "pearl-sparse"))),
        seeds=3,
        eval_freq=100_000,
        evaluations=by(BELIEF),
    ),
    # By measurement on validation tasks, docs/trials.md. An evaluation takes 240,000 env steps, so there are few
    Experiment(
        "point_maze",
        "A point in a maze, its goal hidden.",
        "HiddenPointMazeMedium-v0",
        500_000,
        (Variant("htr-ser", settings={"train_explorer": "belief", "gamma": 0.99}),),
        eval_freq=250_000,
        evaluations=by(BELIEF),
    ),
    # Settings of the maze, and the entropy coefficient of the other ant; no others were tried. Five episodes, as an evaluation
    # of twenty takes hours
    Experiment(
        "ant_maze",
        "An ant in a maze, its goal hidden.",
        "HiddenAntMazeUMaze-v0",
        2_000_000,
        (Variant("htr-ser", settings={"train_explorer": "belief", "gamma": 0.99, "ent_coef": 0.05}),),
        seeds=3,
        eval_freq=250_000,
        evaluations=by(BELIEF),
        n_episodes=5,
    ),
    # RL2 learns slowly; SAC and HER are told the task, and learn fast. Further away there is no training task to relabel under
    Experiment(
        "rivals",
        "HTR against other ways to relabel and to adapt, and against agents that are told more.",
        POINT,
        150_000,
        (
            Variant("htr-ser"),
            Variant("htr-hfr"),
            Variant("htr-hfr", "htr-hfr, tuned", TUNED_HFR),
            Variant("htr-hipi"),
            Variant("htr-hipi", "htr-hipi, tuned", TUNED_HIPI),
            Variant("rl2", budget=10),
            Variant("rl2", "rl2, tuned", TUNED_RL2, budget=10),
            Variant("sac-her", budget=2 / 15),
            Variant("pearl-dense", "pearl-dense, tuned", TUNED_DENSE, budget=3),
        ),
        evaluations=(*by(("belief", "prior")), *by(BELIEF, {"goal_distance": 1.4})),
        figure=figures.race,
    ),
    # HTR paper, figure 11. Steps of an episode for each distance: time to get there, and as long again. The budget is that of
    # episodes of 20 steps; longer ones have as many episodes, and updates in proportion to env steps
    Experiment(
        "goal_distance",
        "Goals ever further away.",
        POINT,
        60_000,
        tuple(
            Variant(method, env_kwargs={"goal_distance": distance, "max_episode_steps": n_steps}, budget=n_steps / 20)
            for distance, n_steps in ((0.5, 20), (0.75, 20), (1.0, 20), (1.5, 30), (2.0, 40))
            for method in ("htr-ser", "pearl-dense", "pearl-sparse")
        ),
        evaluations=by(BELIEF),
        figure=figures.goal_distance,
    ),
    # The first one is what the others are compared with; then the paper's sweep of K, and no relabelling
    Experiment(
        "relabelling",
        "How often to relabel, which hindsight task to choose, and the ablation of HTR paper, B.2.",
        POINT,
        40_000,
        (
            Variant("htr-ser", "K = 0.8"),
            *(Variant("htr-ser", f"K = {k:g}", replay(relabel_probability=k)) for k in (0.0, 0.1, 0.3, 0.5, 1.0)),
            Variant("htr-ser", "random state", replay(relabeller={"hindsight_task_strategy": "random"})),
            Variant("htr-ser", "final state", replay(relabeller={"hindsight_task_strategy": "final"})),
            Variant("htr-ser", "RL batch of the task", replay(relabeller={"rl_batch_source": "task"})),
        ),
        evaluations=by(BELIEF),
        figure=figures.relabelling,
    ),
    Experiment(
        "precision",
        "What matrix products of bfloat16 factors cost.",
        POINT,
        150_000,
        (Variant("htr-ser", "float32"), Variant("htr-ser", "bfloat16", {"matmul_precision": "medium"})),
        evaluations=by(BELIEF),
    ),
)

EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment for experiment in ALL}
