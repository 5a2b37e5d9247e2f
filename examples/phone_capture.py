"""A phone's capture with drifting tracking; phone_capture.md explains the steps.

The notebook is generated from this file (`make docs`).
"""

# %% [markdown]
# # A phone's capture
#
# Capture apps write the poses of the phone's tracking. They are level, thanks to gravity, but heading and position
# drift, each photo jitters, and the focal length is slightly wrong. This script makes such a capture with known true
# poses, and removes the errors again.

# %%
from walk import arguments, in_words, pose_table

import biresnerf
from biresnerf.commands.poses.make_scene import make_scene

here = arguments("phone_capture", views=40, size=200, preset="fast", steps=1200, orbit_frames=0)
print(make_scene(here.scene, "phone", own=here.of, views=here.views, size=here.size, seed=1))
print(pose_table(here.truth, given=here.scene))

# %% [markdown]
# ## Refine
#
# Feature matches check the poses first. Then the two stages refine poses and field together, and the verdict says
# whether the refined poses predict unseen photos better than the phone's.

# %%
result = biresnerf.refine(here.scene, here.refined, progress=True, **here.options)
print(in_words(result))

# %% [markdown]
# ## Before and after, against the truth

# %%
print(pose_table(here.truth, given=here.scene, refined=here.refined))

# %%
result.plot_cameras().figure.savefig(here.output / "cameras.png")
