"""A COLMAP model that lacks half of the images; half_registered.md explains the steps.

The notebook is generated from this file (`make docs`).
"""

# %% [markdown]
# # COLMAP gave up half of the images
#
# A COLMAP model often holds fewer images than the folder. The others are kept. Matches complete the model in its own
# frame, images that matches cannot place get a pose guessed from their neighbours or from similar images, and the
# optimisation refines all of them. Here the model covers the first half of a walk around a table.

# %%
from collections import Counter

from walk import arguments, in_words, pose_table

import biresnerf
from biresnerf.commands.poses.make_scene import make_scene

here = arguments("half_registered", views=40, size=200, preset="fast", steps=1200, orbit_frames=0)
print(make_scene(here.scene, "half", own=here.of, views=here.views, size=here.size, seed=1))
print(pose_table(here.truth, given=here.scene))

# %% [markdown]
# ## Refine
#
# Every image of the folder gets a pose. `pose_source` is the origin of its initial pose.

# %%
result = biresnerf.refine(here.scene, here.refined, progress=True, **here.options)
print(in_words(result))
print("poses began from:", Counter(image.pose_source for image in result.report.images))

# %% [markdown]
# ## Before and after, against the truth

# %%
print(pose_table(here.truth, given=here.scene, refined=here.refined))

# %%
result.plot_cameras().figure.savefig(here.output / "cameras.png")
