"""A COLMAP model that lacks half of the images; half_registered.md walks through it.

The notebook is made of this file (`make docs`).
"""

# %% [markdown]
# # COLMAP gave up half of the images
#
# A COLMAP model often holds fewer images than the folder. The others are kept: matches complete the model in its own
# frame, names and likeness guess what matches cannot place, and the optimisation does the rest. Here the model covers the
# first half of a walk around a table; the other half has to be found from there.

# %%
from collections import Counter

from walk import arguments, in_words, pose_table, show_progress

from biresnerf import refine_poses
from biresnerf.commands.poses.make_scene import make_scene

here = arguments("half_registered", views=40, size=200, preset="fast", steps=1200, orbit_frames=0)
print(make_scene(here.scene, "half", own=here.of, views=here.views, size=here.size, seed=1))
print(pose_table(here.truth, given=here.scene))

# %% [markdown]
# ## Refine
#
# Every image of the folder gets a pose. `pose_source` says who found the one that the optimisation began with.

# %%
report = refine_poses(here.scene, here.refined, here.options, show_progress)
print(in_words(report))
print("poses began from:", Counter(image.pose_source for image in report.images))

# %% [markdown]
# ## Before and after, against the truth

# %%
print(pose_table(here.truth, given=here.scene, refined=here.refined))
