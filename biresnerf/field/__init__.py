"""The radiance field and its rendering on CPU and GPU. Knows neither files nor the optimisation of poses."""
