# %% [markdown]
# # Find devices
# The positions of some devices are known. The others are located from the measurements of two UAVs
# on three flights.

# %%
import radiotwin as rt

rt.build_preset("small", "find_devices/scene")
scene = rt.Scene.load("find_devices/scene")
truth = rt.segmented_truth(scene)
measurements = rt.fly_survey(scene, truth, flights=3, pattern="random-waypoint", seed=0,
                             noise_db=0.0)

# %% [markdown]
# The twin learns the channel from the links of the anchors and locates the unknown devices with it.
# It is compared with a log-distance model, which uses no buildings.

# %%
train, test = rt.split_flights(measurements, held_out=1)
comparison = rt.compare_models(train, test, scene, truth, seed=0,
                               models=("log_distance", "segmented_log_distance"))
print(comparison.location_summary().to_string(index=False))

# %% [markdown]
# Each estimate comes with the radius that holds 90 % of the probability.

# %%
twin = comparison.twins["segmented_log_distance"]
for device in twin.devices:
    if device.role == "unknown":
        print(f"{device.device}: ({device.x_m:.0f}, {device.y_m:.0f}) m, "
              f"within {device.credible_radius_m:.1f} m")
twin.save("find_devices/twin")
