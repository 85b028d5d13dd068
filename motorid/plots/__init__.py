"""Figures, one function per result; the only place that imports matplotlib."""

from motorid.plots.diagnosis import plot_answer, plot_design, plot_ladder, plot_missing, plot_ranking, plot_residuals
from motorid.plots.fits import plot_current_limit, plot_fit, plot_formulations, plot_parameters, plot_runs
from motorid.plots.uncertainty import plot_profile, plot_sensitivities, plot_singular_values, plot_waterfall

__all__ = ["plot_answer", "plot_current_limit", "plot_design", "plot_fit", "plot_formulations", "plot_ladder",
           "plot_missing", "plot_parameters", "plot_profile", "plot_ranking", "plot_residuals", "plot_runs",
           "plot_sensitivities", "plot_singular_values", "plot_waterfall"]
