"""Which z to act with while a task is explored, and afterwards."""

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from sb3_htr.common.settings import plain

if TYPE_CHECKING:
    from sb3_htr.adaptation.adaptation import Adaptation, Step

SelfExplorer = TypeVar("SelfExplorer", bound="Explorer")


@dataclass
class Explorer(ABC):
    """
    Chooses z for several tasks (envs) side by side.

    The object that a model is given holds settings; :meth:`begin` makes a copy that is in charge of one adaptation and owns
    its state. The copy may use the posterior and the episodes of :attr:`adaptation`, and through it what meta-training knows.
    """

    #: Whether it goes by which rewards are those of a success, which not all families tell
    needs_success: ClassVar[bool] = False

    def __new__(cls, *args: Any, **kwargs: Any) -> "Explorer":
        # A subclass may have an __init__ of its own
        explorer = super().__new__(cls)
        explorer.name = cls.__name__.lower()
        return explorer

    def __post_init__(self) -> None:
        for field in fields(self):
            setattr(self, field.name, plain(getattr(self, field.name)))
        #: In YAML files and records
        self.name: str
        self.adaptation: Adaptation
        #: (n_envs, latent_dim) float32, the z to act with from now on
        self.z: np.ndarray

    def begin(self: SelfExplorer, adaptation: "Adaptation") -> SelfExplorer:
        """
        :param adaptation: to several tasks, about to begin
        :return: an explorer with the same settings that is in charge of it
        """
        explorer = copy.copy(self)
        explorer.adaptation = adaptation
        explorer.start()
        return explorer

    @abstractmethod
    def start(self) -> None:
        """Set :attr:`z` for the first episodes."""

    def look(self, obs: np.ndarray) -> None:
        """
        Called before each step, with what is about to be acted on; may set :attr:`z` anew.

        :param obs: (n_envs, obs_dim)
        """

    @abstractmethod
    def observe(self, step: "Step") -> None:
        """
        Set :attr:`z` anew where it changes: at the end of episodes, or within them.

        The adaptation still has the episodes that end with this step as running ones, for :meth:`Adaptation.infer`.

        :param step: what each env did
        """

    @abstractmethod
    def exploring(self) -> np.ndarray:
        """
        :return: (n_envs,) bool, whether it still explores: until the end of the first rewarded episode with ``belief`` and
            ``aggregate``, for ``n_exploration_episodes`` episodes with ``prior`` and ``learned-prior``
        """

    def deviation(self) -> np.ndarray:
        """
        :return: (n_envs, latent_dim), standard deviation of what is known about z
        """
        return self.adaptation.posterior()[1]

    def final_z(self) -> np.ndarray:
        """
        :return: (n_envs, latent_dim), the z to act with when no more episodes follow
        """
        return self.z.copy()
