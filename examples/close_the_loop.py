# %% [markdown]
# # Close the loop
# One receiver reads 6 dB too much, and neither scene nor file says so. Which effect does the model
# lack, and how much smaller is the error with it?

# %%
import radiotwin as rt

rt.build_preset("small", "close_the_loop/scene")
scene = rt.Scene.load("close_the_loop/scene")
correct = rt.fly_survey(scene, rt.segmented_truth(scene), flights=4, pattern="random-waypoint",
                        seed=1, noise_db=0.0)
table = correct.table.copy()
table.loc[table["receiver"] == "uav1", "gain_db"] += 6.0
measurements = rt.Measurements(table, correct.devices)

# %% [markdown]
# The base is a twin with a segmented law over the 3D map. Without the map it would be a
# log-distance law, which errs by 8 dB here: beside that, 6 dB of one receiver are not probable
# enough to be named.

# %%
loop = rt.close_loop(measurements, scene, base="twin", seed=0)
report = rt.make_report(loop)
print("verdict:", report["verdict"])
for effect in report["effects"]:
    print(effect["name"], round(effect["probability"], 2), {
        name: round(parameter["value"], 1) for name, parameter in effect["parameters"].items()})

# %% [markdown]
# The error before and after is that of flights that took no part in the fit. The twin with the
# effect can be saved and used.

# %%
error = report["error"]
print(f"{error['before']['rmse_db']:.2f} dB before, {error['after']['rmse_db']:.2f} dB after")
twin = rt.corrected_twin(loop, scene)
print(twin.description)
twin.save("close_the_loop/twin")
