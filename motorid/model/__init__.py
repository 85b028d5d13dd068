"""A motor as equations: `model.Model`, made of a base and of effects (`definition.effect`)."""
