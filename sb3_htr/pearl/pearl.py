from typing import Any, ClassVar
import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac import SAC
from torch.nn import functional as F
from sb3_htr.common.vec_env import make_task_vec_env
from sb3_htr.htr import MultiTaskReplayBuffer
from sb3_htr.pearl.adaptation import Adaptation
from sb3_htr.pearl.encoder import kl_to_prior
from sb3_htr.pearl.exploration import Explorer, TaskBank
from sb3_htr.pearl.policies import MlpPolicy


class PEARL(SAC):
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}

    def __init__(self, policy, env, learning_rate=1e-3, buffer_size=1_000_000, learning_starts=4000, batch_size=16,
                 tau=0.01, gamma=0.9, gradient_steps=200, ent_coef=0.01, meta_batch_size=64, context_size=20,
                 kl_coef=0.005, tasks_per_rollout=20, n_prior_episodes=5, n_posterior_episodes=5,
                 train_explorer="aggregate", test_explorer="plan",
                 replay_buffer_kwargs=None, policy_kwargs=None, seed=None, verbose=0, device="auto", tensorboard_log=None,
                 _init_setup_model=True):
        if isinstance(env, str):
            env = make_task_vec_env(env, tasks_per_rollout, seed=seed)
        super().__init__(policy, env, learning_rate, buffer_size, learning_starts, batch_size, tau, gamma,
                         gradient_steps=gradient_steps, ent_coef=ent_coef, replay_buffer_class=MultiTaskReplayBuffer,
                         replay_buffer_kwargs=replay_buffer_kwargs, policy_kwargs=policy_kwargs, seed=seed,
                         verbose=verbose, device=device, tensorboard_log=tensorboard_log, _init_setup_model=False)
        self.policy_kwargs.pop("use_sde")
        self.meta_batch_size = meta_batch_size
        self.context_size = context_size
        self.kl_coef = kl_coef
        self.tasks_per_rollout = tasks_per_rollout
        self.n_prior_episodes = n_prior_episodes
        self.n_posterior_episodes = n_posterior_episodes
        self.train_explorer, self.test_explorer = train_explorer, test_explorer
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self):
        self.task_family = self.env.get_attr("task_family")[0]
        self.max_episode_steps = self.env.get_attr("spec")[0].max_episode_steps
        kw = dict(self.replay_buffer_kwargs)
        self.replay_buffer_kwargs = {**kw, "task_family": self.task_family, "max_episode_steps": self.max_episode_steps}
        super()._setup_model()
        self.replay_buffer_kwargs = kw
        self.replay_buffer.seed(self.seed)
        self.rng = np.random.default_rng(self.seed)
        self.bank = TaskBank(self.task_family)
        self._task_queue = np.zeros(0, dtype=int)

    def _create_aliases(self):
        super()._create_aliases()
        self.encoder = self.policy.encoder

    def start_adaptation(self, n_envs, n_exploration_episodes=5, explorer=None, generator=None, context="best"):
        return Adaptation(self.policy, n_envs, n_exploration_episodes, Explorer(explorer or self.test_explorer),
                          self.max_episode_steps, generator, context)

    def _next_tasks(self, n):
        while len(self._task_queue) < n:
            self._task_queue = np.append(self._task_queue, self.rng.permutation(len(self.task_family.train_tasks)))
        tasks, self._task_queue = self._task_queue[:n], self._task_queue[n:]
        return tasks

    def collect_rollouts(self, env, callback, train_freq, replay_buffer, action_noise=None, learning_starts=0, log_interval=None):
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        steps = 0
        n = env.num_envs
        rows = []
        for _ in range(-(-self.tasks_per_rollout // n)):
            tasks = self._next_tasks(n)
            env.set_options([{"task_id": int(t)} for t in tasks])
            self._last_obs = env.reset()
            replay_buffer.discard_open_episodes()
            adaptation = self.start_adaptation(n, self.n_prior_episodes, self.train_explorer)
            left = np.full(n, self.n_prior_episodes + self.n_posterior_episodes)
            while (left > 0).any():
                if self.num_timesteps < learning_starts:
                    buffer_actions = self.rng.uniform(-1, 1, (n, self.action_space.shape[0])).astype(np.float32)
                    actions = self.policy.unscale_action(buffer_actions)
                else:
                    actions, _ = self.policy.predict(self._last_obs, (adaptation.z,), deterministic=False)
                    buffer_actions = self.policy.scale_action(actions)
                obs = self._last_obs
                new_obs, rewards, dones, infos = env.step(actions)
                self.num_timesteps += n
                steps += n
                callback.update_locals(locals())
                if not callback.on_step():
                    return RolloutReturn(steps, 0, continue_training=False)
                self._update_info_buffer(infos, dones)
                before = replay_buffer._open.copy() if dones.any() else None
                self._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)
                goal_reward = rewards - np.array([i["task_free_reward"] for i in infos])
                adaptation.observe(obs, buffer_actions, rewards, dones, goal_reward)
                if dones.any():
                    rows.append(replay_buffer._open[dones].copy())
                self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
                left -= dones
            self._episode_num += n * (self.n_prior_episodes + self.n_posterior_episodes)
        self.bank.update(replay_buffer, np.concatenate(rows))
        callback.on_rollout_end()
        if log_interval:
            self.dump_logs()
        return RolloutReturn(steps, 0, continue_training=True)

    def train(self, gradient_steps, batch_size):
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer, self.encoder.optimizer])
        M, B = self.meta_batch_size, batch_size
        ent_coef = self.ent_coef_tensor
        means, log = [], []
        params, tparams = list(self.critic.parameters()), list(self.critic_target.parameters())
        for step in range(gradient_steps):
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env, meta_batch_size=M, context_size=self.context_size)
            mean, var = self.encoder(data.context, data.context_mask)
            z = mean + var.sqrt() * th.randn_like(mean)
            kl = kl_to_prior(mean, var).mean()
            means.append(mean.detach())
            z_rows = z.unsqueeze(1).expand(-1, B, -1)
            obs_z = th.cat([data.observations, z_rows], -1).flatten(0, 1)
            actions = data.actions.flatten(0, 1)
            with th.no_grad():
                next_obs_z = th.cat([data.next_observations, z_rows], -1).flatten(0, 1)
                next_actions, next_log_prob = self.actor.action_log_prob(next_obs_z)
                next_q = self.critic_target(next_obs_z, next_actions).amin(0) - ent_coef * next_log_prob
                target = data.rewards.flatten() + (1 - data.dones.flatten()) * self.gamma * next_q
            q = self.critic(obs_z, actions)
            critic_loss = (q - target).square().mean() * len(q)
            self.critic.optimizer.zero_grad()
            self.encoder.optimizer.zero_grad()
            (critic_loss + self.kl_coef * kl).backward()
            self.critic.optimizer.step()
            self.encoder.optimizer.step()
            obs_z = obs_z.detach()
            pi, log_prob = self.actor.action_log_prob(obs_z)
            self.critic.requires_grad_(False)
            actor_loss = (ent_coef * log_prob - self.critic(obs_z, pi).amin(0)).mean()
            self.actor.optimizer.zero_grad()
            actor_loss.backward()
            self.critic.requires_grad_(True)
            self.actor.optimizer.step()
            with th.no_grad():
                th._foreach_lerp_(tparams, params, self.tau)
            if step == gradient_steps - 1:
                log = [critic_loss.item(), actor_loss.item(), kl.item()]
        self._n_updates += gradient_steps
        self.policy.latent_prior.fit(th.cat(means[-20:]))
        self._update_plan()
        for k, v in zip(["critic_loss", "actor_loss", "kl"], log):
            self.logger.record(f"train/{k}", v)
        self.logger.record("train/solved", int(self.bank.solved.sum()))

    def _update_plan(self):
        tasks, rows = self.bank.search_plan(self.replay_buffer)
        if len(tasks):
            ctx = th.as_tensor(rows[..., : self.policy.context_dim])
            with th.no_grad():
                mean, _ = self.encoder(ctx, th.ones(ctx.shape[:2]))
            self.policy.latent_prior.set_plan(mean)
