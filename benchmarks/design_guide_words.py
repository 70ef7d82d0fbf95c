"""What the page of the design guide says around its tables."""

HEAD = """# What brings how much

Errors of the slippage and of the depth of windows (a quarter of the frame wide) by the reference reader of
`metalens evaluate optics --reader`, trained anew behind every lens on its true image: whole field, depth, spectrum. In
every row one knob differs from the base: hyperbolic lens in focus at 40 mm, 1 mm wide, 2 mm before the sensor; ±14°
about the axis; one wavelength; pixels of 18 µm; 2000 e from white in 9 µm; {frames} frames to learn from. Scenes, noise
and weights come from the seed. Brackets are 95 % intervals over the seeds (Student's), of ratios those of the
logarithms paired by seed: they hold what differs from seed to seed and nothing else. `trusted`: the half of the windows
of which the reader is surest. Images hold to 0.05 of a texture's contrast; where the spectrum's own share is below that
one wavelength stands for it (10 nm: 0.006, 30 nm: up to 0.017 of the contrast). Gaze is
that of the elastic network, further down.

Made by `python -m benchmarks.design_guide run --work DIR`, and `report`; `--only CELL/SEED` reruns one. All numbers,
and the coefficients of the trained lenses, are in `benchmarks/results/design_guide.json`.
"""
FIELD = """
## Field and light of the device

`oblique`: a camera that looks from one side, {oblique} along x and ±14° along y. `ring`: {ring} about the axis, both
ways. Frames are those of a camera that faces the eye; their images are those of that part of the field. Every lens of a
family was chosen by axial error with a seed of its own, for that field and light. `focus`: hyperbolic, in focus at
{foci} mm. `designer`: r² alone (blur of all angles alike) or, in the oblique field, free of aberrations at its
middle, in focus at {designers} mm. `trained`: 63 free-form terms moved from the best of all of these along the exact
gradient of the likelihood of the windows' depths, as far as its running mean is longer than noise would leave it
({turns} turns, {hold} steps of the reader's branch to each, 32 frames a step; the lens stands for the first
{still:.0f} %), trained once, on an image to {coarse:g} of the contrast. The start and the lenses after {looks} % of the
turns are read on frames that trained nothing, the one of least axial error is kept, and every seed reads it. `asphere`:
six radial terms, from the best focus, likewise. `stop`: six radial terms behind a hole of 1 mm on the other face of
0.5 mm of fused silica, of least wave-front error over the field, in focus at {stops} mm, as it stands. `bound`: what
the blur of one window alone can tell, the least standard deviation of its depth, mean over the windows of the field
and the depths, for a patch of unknown 1/f texture of contrast 0.2, its contrast and fall unknown too, in the photons'
noise, where depths spread by 3 mm beforehand; that less light falls towards the rim is left out.
Readers see edges and neighbouring windows as well, and may do better.
"""
RUNGS = """\
## Where the gain is lost

Scenes, pixels and light of the oblique field at 30 nm; PSFs held over the field. `angle`: every window through the PSFs
of the middle, 17°. `line`: PSFs that vary along x as in the oblique field, and along y not at all. `oblique`: the true
image. Every rung has its own best focus, designer's lens and trained lens, chosen and trained as above.
"""
LONG = """\
### {field}, {fwhm:g} nm, after more frames

The same lenses, read by a reader that has learned from {many} frames in place of {frames}. Lenses that differ above and
not here differ in how soon their blur is learned, not in what is told by it.
"""
NETWORK = """\
## Another reader

The elastic network of the co-design study, trained anew behind each of the lenses of the oblique field at 30 nm that
stand, on the same true image: {frames} frames, each seen once, the same for all lenses of a seed; judged on the
test frames of the reference reader ({macs:.2f} MMACs), and by gaze: {people} people, a personal calibration on a fifth
of {each} frames each.
"""
