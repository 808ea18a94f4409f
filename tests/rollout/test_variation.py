"""Light, camera and vehicle that differ from drive to drive."""

from __future__ import annotations

from dataclasses import asdict, replace

import drjit as dr
import numpy as np
import pytest
from support.files import objects as made
from support.worlds import loops as toy

from mi_nerfattack.deploy.surrogate.environment import take_apart
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import from_fov
from mi_nerfattack.render.lighting.shading import LightMaps
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.splatting.background import SplatBackground
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop, simulate
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.rollout.scene_sensor import SceneSensor
from mi_nerfattack.rollout.variation import SunRanges, Variation, Varied
from mi_nerfattack.vehicle.bicycle import RateLimitedAckermann
from mi_nerfattack.vehicle.dynamics import Ackermann, Dubins, to_control, to_state
from mi_nerfattack.vehicle.integrators import RK4, ImplicitMidpoint
from mi_nerfattack.vehicle.single_track import KinematicSingleTrack

pytestmark = pytest.mark.usefixtures("variant")

ALL = Variation(
    0.5, 0.4, 3.0, 0.2, 0.15, 0.25, 0.2, delay_s_sd=0.1, sun=SunRanges(), seed=4
)
POSES = np.array([[0.0, 0.35, 0.02], [0.3, 0.2, -0.04], [-0.2, -0.1, 0.08]])


def varied(variation: Variation = ALL) -> tuple[ClosedLoop, SceneSensor]:
    """Return a loop whose drives differ, and its sensor as it was."""
    loop, _ = toy.make_loop()
    plain = loop.sensor
    assert isinstance(plain, SceneSensor)
    dynamics = Varied(loop.dynamics, variation, loop.transition.dt)
    return replace(loop, sensor=plain.varied(variation), dynamics=dynamics), plain


def test_draws_have_the_given_deviations_and_belong_to_a_drive():
    drawn = ALL.draws(0, 40000)
    light = np.log2(drawn.light)
    assert light.std(1) == pytest.approx(np.hypot(0.5, 0.4), rel=0.03)
    # what the channels share is the light's brightness
    shared = np.cov(light)[0, 1]
    assert shared == pytest.approx(0.25, rel=0.05)
    factors = np.log([drawn.height, drawn.speed, drawn.steering])
    assert factors.std(1) == pytest.approx([0.2, 0.15, 0.25], rel=0.03)
    assert drawn.pitch_deg.std() == pytest.approx(3, rel=0.03)
    assert (
        abs(np.corrcoef(np.vstack([factors, drawn.pitch_deg])) - np.eye(4)).max() < 0.03
    )
    # the mean size of a normal number is sqrt(2 / pi)
    assert drawn.lag_s.mean() == pytest.approx(0.2 * np.sqrt(2 / np.pi), rel=0.03)
    assert drawn.delay_s.mean() == pytest.approx(0.1 * np.sqrt(2 / np.pi), rel=0.03)
    assert abs(np.corrcoef(drawn.lag_s, drawn.delay_s)[0, 1]) < 0.03
    later = ALL.draws(2, 3)
    assert np.array_equal(later.light, drawn.light[:, 2:5])
    assert np.array_equal(later.speed, drawn.speed[2:5])
    assert np.array_equal(later.lag_s, drawn.lag_s[2:5])
    assert np.array_equal(later.delay_s, drawn.delay_s[2:5])


def test_suns_are_spread_over_their_ranges_and_belong_to_a_drive():
    ranges = SunRanges((10, 70), (-90, 90), (0.2, 0.8), (4000, 6500))
    variation = Variation(sun=ranges, seed=4)
    numbers = np.array([list(asdict(sun).values()) for sun in variation.suns(0, 4000)])
    low, high = np.transpose(list(asdict(ranges).values()))
    share = (numbers - low) / (high - low)
    assert share.min() >= 0 and share.max() <= 1
    assert share.mean(0) == pytest.approx(np.full(4, 0.5), abs=0.02)
    assert share.std(0) == pytest.approx(np.full(4, 12**-0.5), rel=0.03)
    assert abs(np.corrcoef(share.T) - np.eye(4)).max() < 0.06
    assert variation.suns(2, 3) == variation.suns(0, 5)[2:]
    assert variation.of_light and not variation.of_vehicle


def test_light_multiplies_what_an_object_gives():
    variation = Variation(0.8, 0.5, seed=1)
    loop, plain = varied(variation)
    state = loop.initial(POSES)
    before, after = plain.observe(state, 0), loop.sensor.observe(state, 0)
    shown = take_apart(plain, before, dr.zeros(type(before.linear.x), 1))
    object_alone = shown.objects[0].radiance.numpy()
    gain = np.repeat(variation.draws(0, 3).light, toy.WIDTH * toy.HEIGHT, axis=1)
    expected = before.linear.numpy() + (gain - 1) * object_alone
    assert abs(expected - before.linear.numpy()).max() > 0.05
    np.testing.assert_allclose(after.linear.numpy(), expected, atol=2e-6)


def test_each_drive_has_its_own_sun():
    """What is seen of an object changes by factors that its drive's map has."""
    variation = Variation(sun=SunRanges(), seed=1)
    loop, plain = varied(variation)
    state = loop.initial(POSES)
    before, after = plain.observe(state, 0), loop.sensor.observe(state, 0)
    shown = take_apart(plain, before, dr.zeros(type(before.linear.x), 1))
    (posed,) = plain.objects
    maps = posed.light_maps
    assert isinstance(maps, LightMaps)
    rows = maps.rows(variation.suns(0, 3), posed.placed.rotation)
    assert len(set(rows)) == 3 and 0 not in rows
    table = maps.table.numpy().reshape(-1, int(np.prod(maps.shape)), 4)[rows, :, :3]
    alone = shown.objects[0].radiance.numpy().reshape(3, 3, -1)
    change = (after.linear.numpy() - before.linear.numpy()).reshape(3, 3, -1)
    for k in range(3):
        low, high = table[k].min() - 1, table[k].max() - 1
        assert (change[:, k] >= low * alone[:, k] - 1e-5).all()
        assert (change[:, k] <= high * alone[:, k] + 1e-5).all()
        assert abs(change[:, k]).max() > 0.02


def test_each_drive_has_its_own_mount():
    loop, plain = varied(Variation(pitch_deg_sd=3.0, height_sd=0.2, seed=2))
    images = loop.sensor.observe(loop.initial(POSES), 0).image.numpy()
    drawn = Variation(pitch_deg_sd=3.0, height_sd=0.2, seed=2).draws(0, 3)
    for k, pose in enumerate(POSES):
        mount = replace(
            toy.MOUNT,
            height_m=toy.MOUNT.height_m * drawn.height[k],
            pitch_deg=toy.MOUNT.pitch_deg + drawn.pitch_deg[k],
        )
        camera = plain.camera
        other = SceneSensor(
            plain.scene, mount, sensor=camera.sensor, centred=camera.centred
        )
        alone = other.observe(loop.initial(pose), 0).image.numpy()[0]
        np.testing.assert_allclose(images[k], alone, atol=1e-5)
    assert (
        abs(images[0] - plain.observe(loop.initial(POSES), 0).image.numpy()[0]).max()
        > 0.01
    )


@pytest.mark.parametrize(
    "model",
    [
        Dubins(5, 1.5),
        Ackermann(5, 2.7, 0.6),
        RateLimitedAckermann(5, 2.7, 0.6, 0.7, 0.1),
    ],
)
def test_each_drive_has_its_own_vehicle(model):
    """That of another speed and, where the model has one, another wheelbase."""
    variation = Variation(speed_sd=0.2, steering_sd=0.3, seed=3)
    drawn = variation.draws(0, 3)
    rows = model.state_size
    vehicle = Varied(model, variation, 0.1)
    loop, _ = toy.make_loop()
    start = replace(loop, dynamics=model).initial(POSES)
    control = type(start[0])([0.3, -0.2, 0.1])
    derivative = np.array(vehicle.derivative(start, control))
    for k in range(3):
        own = {"speed": model.speed * drawn.speed[k]}
        if rows > 3 or isinstance(model, Ackermann):
            own["wheelbase"] = model.wheelbase / drawn.steering[k]
        expected = np.array(replace(model, **own).derivative(start, control))[:, k]
        if isinstance(model, Dubins):
            expected[2] *= drawn.steering[k]
        np.testing.assert_allclose(derivative[:, k], expected, rtol=1e-12)


def test_a_vehicle_with_a_speed_state_is_faster_at_each_speed():
    model = KinematicSingleTrack(8.0)
    variation = Variation(speed_sd=0.2, steering_sd=0.3, seed=3)
    vehicle = Varied(model, variation, 0.1)
    assert vehicle.control_names == model.control_names
    state = to_state(np.repeat(model.extend(np.zeros(3)), 3, 0))
    control = to_control(np.array([[0.1, 1.0]] * 3))
    drawn = vehicle.variation.draws(0, 3)
    slope = vehicle.derivative(state, control).numpy()
    np.testing.assert_allclose(vehicle.speed_of(state), 8 * drawn.speed)
    turn = 8 / 2.7 * np.tan(0.1) * drawn.speed * drawn.steering
    np.testing.assert_allclose(slope[2], turn)
    np.testing.assert_allclose(slope[3], 1.0)


@pytest.mark.parametrize("integrator", [RK4(), ImplicitMidpoint()])
def test_steering_follows_its_command_by_a_lag(integrator):
    """As the solution of the equation has it; the lag is a step at least."""
    variation = Variation(steering_lag_s_sd=0.5, seed=3)
    step, command = 0.05, 0.3
    lag = np.maximum(variation.draws(0, 3).lag_s, step)
    vehicle = Varied(Dubins(5, 1.5), variation, step)
    assert (vehicle.state_size, vehicle.own_rows) == (4, 3)
    state = to_state(vehicle.extend(POSES))
    control = type(state[0])([command] * 3)
    for _ in range(16):
        state = integrator.step(vehicle, state, control, step)
    end = 16 * step
    acting = command * (1 - np.exp(-end / lag))
    turned = command * (end - lag * (1 - np.exp(-end / lag)))
    np.testing.assert_allclose(np.array(state)[3], acting, rtol=0.01)
    heading_change = np.array(state)[2] - POSES[:, 2]
    np.testing.assert_allclose(heading_change, turned, rtol=0.01, atol=1e-3)


def test_costs_see_the_rows_of_the_vehicle_alone():
    """A cost of all rows is the model's; its derivative by the lag's row is 0."""
    loop, _ = toy.make_loop()
    vehicle = Varied(loop.dynamics, Variation(steering_lag_s_sd=0.2, seed=3), 0.1)
    loop, row_counts = replace(loop, dynamics=vehicle), []

    def cost(state):
        row_counts.append(len(state))
        return state[len(state) - 1] ** 2  # the heading

    rollout = Rollout(loop, StageSum(cost), 3)
    evaluation = rollout.run(loop.initial(POSES))
    headings = evaluation.trajectory.states_numpy()[:, 1:, 2]
    np.testing.assert_allclose(evaluation.costs, (headings**2).sum(1), rtol=1e-6)
    assert rollout.gradient(evaluation).costates.shape == (3, 3, 4)
    assert set(row_counts) == {3}


def test_a_lag_of_the_steering_leaves_the_pedals_alone():
    model = KinematicSingleTrack(8.0)
    vehicle = Varied(model, Variation(steering_lag_s_sd=0.2, seed=3), 0.1)
    state = to_state(np.repeat(vehicle.extend(np.zeros(3)), 3, 0))
    control = to_control(np.array([[0.1, 1.0]] * 3))
    after = np.array(toy.EULER.step(vehicle, state, control, 0.1))
    np.testing.assert_allclose(after[3], 8.1)
    assert (after[4] > 0).all() and (after[4] <= 0.1).all()


def test_a_varied_drive_is_the_same_in_any_batch_and_from_run_to_run():
    loop, plain = varied()
    batch = simulate(loop, loop.initial(POSES), 8).states_numpy()
    assert np.array_equal(simulate(loop, loop.initial(POSES), 8).states_numpy(), batch)
    for k, pose in enumerate(POSES):
        alone = simulate(loop.numbered(k), loop.initial(pose), 8).states_numpy()
        np.testing.assert_allclose(alone[0], batch[k], atol=1e-5)
    nominal = replace(loop, sensor=plain, dynamics=loop.dynamics.model)
    other = simulate(nominal, nominal.initial(POSES), 8).states_numpy()
    assert abs(other - batch[..., :3]).max() > 0.05


def test_the_light_turns_with_an_object_that_an_attack_turns():
    """The order of moves decides nothing: no map is of the first pose that was seen."""
    loop, plain = varied(Variation(sun=SunRanges(), seed=1))
    state, (posed,) = loop.initial(POSES), plain.objects
    before = loop.sensor.observe(state, 0).linear.numpy()
    posed.move(np.array([0, 0, 0, 0, 0, 0.4]))
    turned = loop.sensor.observe(state, 0).linear.numpy()
    assert abs(turned - before).max() > 0.01
    other = plain.varied(Variation(sun=SunRanges(), seed=1))
    np.testing.assert_array_equal(other.observe(state, 0).linear.numpy(), turned)


@pytest.mark.parametrize("adjoint", toy.ADJOINTS)
def test_gradients_are_those_of_the_varied_drives(adjoint):
    """Attached, so that light, mount and vehicle are all in the derivative."""
    loop, _ = varied()
    loop = replace(loop, eight_bit=False)
    rollout = toy.make_rollout(loop, 6, attached=True, adjoint=adjoint)
    initial = loop.initial(POSES)
    field = loop.sensor.fields[0]
    before = toy.texture_of(field)
    along = np.random.default_rng(0).normal(size=before.shape).astype(np.float32)

    def value(step: float) -> float:
        loop.sensor.set_textures([before + step * along])
        return rollout.measure(initial).value

    difference = (value(1e-2) - value(-1e-2)) / 2e-2
    loop.sensor.set_textures([before])
    gradient = rollout.gradient(rollout.run(initial)).textures[0].numpy()
    assert (gradient * along).sum() == pytest.approx(difference, rel=0.02)


def test_light_falls_on_the_objects_that_there_were():
    loop, plain = varied()
    sensor, state = loop.sensor, loop.initial(POSES)
    before = sensor.observe(state, 0).image.numpy()
    sensor.select(())
    assert np.array_equal(sensor.observe(state, 0).image.numpy(), before)
    assert plain.renders == 6  # of copies, too
    with pytest.raises(InputError, match="no objects .*field_integrator"):
        plain.varied(ALL)
    assert plain.varied(Variation(pitch_deg_sd=1)).camera is not plain.camera


def test_light_leaves_splats_as_they_were_captured():
    _, item = toy.make_loop()
    background = SplatBackground(made.splats([12.0, 0.6, 1.0], scales=1.5))
    posed = PosedField(item, toy.OBJECT_POSE)
    camera = from_fov(toy.WIDTH, toy.HEIGHT, 70.0)
    plain = field_sensor(background, [posed], camera, toy.MOUNT)
    state, light = to_state(POSES), Variation(0.8, 0.5, seed=1)
    before = plain.observe(state, 0)
    after = plain.varied(light).observe(state, 0)
    shown = take_apart(plain, before, dr.zeros(type(before.linear.x), 1))
    gain = np.repeat(light.draws(0, 3).light, toy.WIDTH * toy.HEIGHT, axis=1)
    added_light = (gain - 1) * shown.objects[0].radiance.numpy()
    expected = before.linear.numpy() + added_light
    assert shown.others[0].opacity.numpy().max() > 0.1 and abs(added_light).max() > 0.05
    np.testing.assert_allclose(after.linear.numpy(), expected, atol=2e-6)
