"""A phone's capture whose tracking drifted; phone_capture.md walks through it.

The notebook is made of this file (`make docs`).
"""

# %% [markdown]
# # A phone's capture
#
# Capture apps write the poses that the phone's tracking had: level, since gravity holds them, but with a heading and a
# position that drift, a jitter in each photo, and a focal length that is not quite the lens's. We make such a capture,
# with the truth beside it, and take the errors out again.

# %%
from walk import arguments, in_words, pose_table, show_progress

from biresnerf import refine_poses
from biresnerf.commands.poses.make_scene import make_scene

here = arguments("phone_capture", views=40, size=200, preset="fast", steps=1200, orbit_frames=0)
print(make_scene(here.scene, "phone", own=here.of, views=here.views, size=here.size, seed=1))
print(pose_table(here.truth, given=here.scene))

# %% [markdown]
# ## Refine
#
# Feature matches check the poses first; then the two stages move poses and field together, and the verdict says whether
# the refined poses predict unseen photos better than the phone's.

# %%
report = refine_poses(here.scene, here.refined, here.options, show_progress)
print(in_words(report))

# %% [markdown]
# ## Before and after, against the truth

# %%
print(pose_table(here.truth, given=here.scene, refined=here.refined))
