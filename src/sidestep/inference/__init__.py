"""From likelihood to a learned model: priors, and fits that maximise the posterior."""
