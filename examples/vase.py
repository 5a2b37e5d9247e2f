"""A plain vase with rough poses; vase.md explains the steps.

The notebook is generated from this file (`make docs`).
"""

# %% [markdown]
# # A plain vase
#
# A glazed vase has hardly any features. But the poses are roughly known, from a turntable or a rig, and outline, light
# and slow changes of colour are enough for a field.

# %%
from walk import arguments, in_words, pose_table

import biresnerf
from biresnerf.commands.poses.make_scene import make_scene

here = arguments("vase", views=40, size=160, preset="fast", steps=1500, holdout=8, orbit_frames=0)
print(make_scene(here.scene, "vase", own=here.of, views=here.views, size=here.size, noise=0.1, seed=1))
print(pose_table(here.truth, given=here.scene))

# %% [markdown]
# ## Refine
#
# The few matches may mislead. A trial on unseen views decides whether to start from them.

# %%
result = biresnerf.refine(here.scene, here.refined, progress=True, **here.options)
print(in_words(result))

# %% [markdown]
# ## Before and after, against the truth

# %%
print(pose_table(here.truth, given=here.scene, refined=here.refined))

# %%
result.plot_cameras().figure.savefig(here.output / "cameras.png")
