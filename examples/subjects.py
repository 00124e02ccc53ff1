"""Choices of six subjects in a two-step task: their beliefs about transitions, a β of each, and a comparison of models.

States: 0 is the first choice, 1 and 2 are the second ones, 3 pays 1 and 4 pays nothing. Every action has two outcomes.
To fit your own data, replace `trajectories`, one for each trial: the states, one more than actions because the last
outcome is a state too, the actions, and the subject (0, 1, …) as its `task`. From a table of trials with pandas:

    for (subject, _), rows in table.groupby(["subject", "trial"]):
        states = np.append(rows["state"], rows["next_state"].iloc[-1])
        trajectories.append(ss.Trajectory(states, rows["action"].to_numpy(), task=subject))
"""

import jax
import jax.numpy as jnp
import numpy as np

import sidestep as ss
from sidestep.tabular.models import FIXED

jax.config.update("jax_enable_x64", True)

# the MDP: the next state of every (state, action, outcome), and the reward of every state
successors = np.array([[[1, 2], [1, 2]], [[3, 4], [3, 4]], [[3, 4], [3, 4]], [[3, 3], [3, 3]], [[4, 4], [4, 4]]])
graph = ss.graph(successors)
task = ss.task(reward=np.array([0.0, 0, 0, 1, 0]), discount=0.99, terminal=np.array([False, False, False, True, True]))

# simulated subjects know the transition probabilities (logits of the two outcomes; the others are certain)
logits = np.zeros(successors.shape)
logits[0, :, 0], logits[1, :, 0], logits[2, :, 0] = [1.5, -1.5], [1.5, 0.0], [-1.0, -1.0]
truth = ss.TabularModel(graph, jnp.asarray(logits))
true_betas = [2.0, 4.0, 6.0, 2.0, 4.0, 6.0]
trajectories = []
for subject, beta in enumerate(true_betas):
    agent = ss.Behavior(ss.BoltzmannAverage(), beta=beta, lapse=0.05)
    trials = ss.simulate(jax.random.key(subject), truth, [task], [np.zeros(100, dtype=int)], agent)
    trajectories += [ss.Trajectory(trial.states, trial.actions, task=subject) for trial in trials]

# one task a subject, all alike: so the β of each subject is learned (pooled), and a lapse that all share
subjects = len(true_betas)
data = ss.gather(trajectories, [task] * subjects)
start = ss.Behavior(ss.BoltzmannAverage(), beta=4.0, lapse=0.05)
unknown = ss.behavior_model(start, ["beta", "lapse"], person=np.arange(subjects))

# two models: the outcomes of every choice have their own logit, or all first choices are equally reliable
index = np.full(successors.shape, FIXED)  # a logit of 0
index[0, 0, 0] = index[0, 1, 1] = 0  # the common outcome of either first choice
index[1:3, :, 0] = [[1, 2], [3, 4]]
models = {"separate": ss.TabularModel(graph, jnp.zeros(successors.shape)), "tied": ss.TiedModel(graph, index)}

by_subject = np.array([trajectory.task for trajectory in trajectories])
fits = {name: ss.fit(model, data, unknown, prior=ss.Normal(0.0, 2.0)) for name, model in models.items()}
for name, fit in fits.items():
    print(f"{name}: {fit.message}; log-likelihood {fit.final.actions + fit.final.transitions:.1f} nats")
    print(f"  P(common) of the first choices: {fit.model.probabilities()[0, [0, 1], [0, 1]].round(2)}")
    for subject in range(subjects):
        behavior = fit.behavior.behavior_of(subject)
        likelihood = ss.log_likelihood(fit.model, data.with_only(by_subject == subject), behavior)
        print(f"  subject {subject}: β {behavior.beta:.1f}, log-likelihood of choices {likelihood.actions:.1f}")
    print(f"  lapse {fit.behavior.behavior_of().lapse:.3f}, the same for all")

# beliefs of one subject, from choices alone: a fit of this subject's trials only. Choices alone do not tell a larger β
# from beliefs in less certain outcomes, so β is the one that the fit of all subjects found
alone = ss.fit(
    models["separate"],
    ss.gather([trajectory._replace(task=0) for trajectory in trajectories if trajectory.task == 2], [task]),
    ss.behavior_model(fits["tied"].behavior.behavior_of(2)),
    prior=ss.Normal(0.0, 2.0),
    terms=("actions",),
)
believed = alone.model.probabilities()[0, [0, 1], [0, 1]].round(2)
print(f"subject 2 believes that the first choices have P(common) {believed}")
