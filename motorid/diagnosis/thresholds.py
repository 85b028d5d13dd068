"""Every judgement of the diagnosis that is a number: its meaning, its unit, and the case or curve that fixes it."""

# -- the predictive score (see `predictive_score`) -------------------------------------------------------------
BLOCKS = 20  # per run: enough for a standard error of their scatter (where they end: `predictive_score.blocks_of`)
DEGREES_OF_FREEDOM = 4  # of Student's t: a Gaussian takes offsets for friction on real records, whose errors have tails
STANDARD_ERRORS = 2.0  # that a gain must be: chance lets 1 % of false effects in at 15 effective samples per run
NATS = 4.0  # that a gain must be at least: 2 to 4 let the same in on 438 pairs of models
MATERIAL = 0.01  # fall of the prediction error that matters: no false effect of 306 reached 0.1 %
PLAIN = 0.1  # error, or fall of it, that is plain to see: an arm's weight makes it 0.6
SEARCHED = 200  # orders of cogging or ripple, of which the best is taken: the gain of chance grows by their logarithm
LOST = 1.0  # NRMSE beyond which a channel is lost: zero is nearer to what was measured
UNRELIABLE = 1.5  # times the error of the fit: a prediction without a block by slopes is within 1.08 where it holds

# -- noise ------------------------------------------------------------------------------------------------------
LARGER = 1.5  # of residual to noise: beyond it the noise must be coloured, or something is missing
FINER = 1e-3  # share of an angle, RMS, below which its error is asked no more, and
FINER_RATE = 5e-3  # share of the speed, RMS, for the rate of that error: encoders saw true models fail by 2e-4 and 3e-3

# -- what an effect may be called -----------------------------------------------------------------------------------
CONTAINED = 0.1  # of what an effect puts into its balance, RMS: what a free form may miss and still contain it
TRIFLE = 0.1  # of what an effect does, RMS, in its balance and in the outputs: what a form must add to differ from it
ELSEWHERE = 3.0  # times the error on blocks left out (or the noise), on held-out runs: another regime, worth a word
SUPPLANTS = 0.05  # fall of the error by a free form in an effect's place; on a real record friction leaves it 0.034
MOST = 0.5  # of the squared error without it, or of a channel: what explains less than it leaves is not what is missing
UNCONTESTED = 0.9  # the same where no free form can take its place: backlash explains 0.86 of a shaft that stiffens
