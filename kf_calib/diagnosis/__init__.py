"""Which effect is missing: hypotheses, evidence, verdict, stepwise selection."""
