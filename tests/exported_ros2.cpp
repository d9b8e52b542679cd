// The exported plug-in of ros2_control in a robot of MuJoCo, for test_exported.py: ./ros2 MODEL.
// Its torques are those of controller_step_at. Prints the line of the first failure, and the walk.
#include <mujoco/mujoco.h>

#include <algorithm>
#include <cmath>
#include <cstring>

#include "controller.h"
#include "controller_interface/controller_interface.hpp"
#include "geometry_msgs/msg/twist.hpp"

#define CHECK(what) do { if (!(what)) return std::printf("line %d fails\n", __LINE__), 1; } while (0)

using controller_interface::CallbackReturn;
using geometry_msgs::msg::Twist;
using Plugin = controller_interface::ControllerInterface;

std::unique_ptr<Plugin> make_plugin();

static const char *joint_names[CONTROLLER_JOINTS] = CONTROLLER_JOINT_NAMES;
static std::unique_ptr<Plugin> plugin;
static struct controller direct;
static struct controller_output expected;
static mjModel *model;
static mjData *data;
static std::map<std::string, double> bus; // the hardware's values by the interfaces' names

static void measure(struct controller_estimate &e)
{
    const char *axes[4] = {"w", "x", "y", "z"};
    for (int i = 0; i < 4; ++i) bus[std::string("trunk/orientation.") + axes[i]] = data->qpos[3 + i];
    for (int i = 0; i < 3; ++i) {
        const std::string axis = std::string(".") + axes[i + 1];
        bus["trunk/angular_velocity" + axis] = data->qvel[3 + i];
        bus["odometry/position" + axis] = data->qpos[i];
        bus["odometry/linear_velocity" + axis] = data->qvel[i];
    }
    controller_from_imu(data->qpos + 3, data->qvel + 3, data->qpos, data->qvel, &e);
    for (int i = 0; i < CONTROLLER_JOINTS; ++i) {
        const int joint = mj_name2id(model, mjOBJ_JOINT, joint_names[i]);
        bus[std::string(joint_names[i]) + "/position"] = e.joints[i] = data->qpos[model->jnt_qposadr[joint]];
        bus[std::string(joint_names[i]) + "/velocity"] = e.joint_rates[i] = data->qvel[model->jnt_dofadr[joint]];
    }
}

static double effort(int j) { return bus.at(std::string(joint_names[j]) + "/effort"); }

// A millisecond of both; 0 if their torques differ in a bit.
static int step(int64_t ms)
{
    struct controller_estimate e;
    measure(e);
    const bool done = plugin->update(rclcpp::Time(5000000000 + 1000000 * ms), rclcpp::Duration(1000000)) ==
                      controller_interface::return_type::OK;
    controller_step_at(&direct, ms, &e, nullptr, nullptr, &expected);
    for (int j = 0; j < CONTROLLER_JOINTS; ++j) {
        if (effort(j) != expected.torque[j]) return 0;
        data->ctrl[j] = effort(j);
    }
    mj_step(model, data);
    return done;
}

static void lend(std::vector<hardware_interface::Loaned> &to, const std::vector<std::string> &names)
{
    to.clear();
    for (const std::string &name : names) to.emplace_back(name, &bus[name]);
}

static void say(double ahead, double left, double turn)
{
    Twist twist;
    twist.linear.x = ahead, twist.linear.y = left, twist.angular.z = turn;
    std::static_pointer_cast<rclcpp::Subscription<Twist>>(plugin->get_node()->topics.at("~/cmd_vel"))->callback(twist);
}

static rcl_interfaces::msg::SetParametersResult set(const std::string &name, const std::vector<double> &values)
{
    return plugin->get_node()->on_set.lock()->callback({rclcpp::Parameter(name, values)});
}

static int begin()
{
    mj_resetDataKeyframe(model, data, 0);
    controller_reset(&direct);
    expected = {};
    return plugin->on_activate({}) == CallbackReturn::SUCCESS;
}

static int test_configuration()
{
    plugin = make_plugin();
    plugin->get_node()->values["friction"] = std::vector<double>{-1.0};
    CHECK(plugin->on_init() == CallbackReturn::SUCCESS && plugin->on_configure({}) == CallbackReturn::ERROR);
    plugin = make_plugin();
    plugin->get_node()->values["friction"] = 0.6; // no array
    CHECK(plugin->on_init() == CallbackReturn::ERROR);
    plugin = make_plugin();
    plugin->get_node()->values["imu"] = std::string("trunk");
    CHECK(plugin->on_init() == CallbackReturn::SUCCESS && plugin->on_configure({}) == CallbackReturn::SUCCESS);
    const auto commands = plugin->command_interface_configuration().names;
    auto states = plugin->state_interface_configuration().names;
    lend(plugin->command_interfaces_, commands);
    std::swap(states[0], states[1]);
    lend(plugin->state_interfaces_, states);
    CHECK(plugin->on_activate({}) == CallbackReturn::ERROR); // in another order
    std::swap(states[0], states[1]);
    lend(plugin->state_interfaces_, states);
    return 0;
}

static int test_walk()
{
    const double friction = controller_exported.friction;
    struct controller_tunables softer = controller_exported;
    int64_t ms = 0;
    CHECK(begin());
    for (; ms < CONTROLLER_TICK_0; ++ms) CHECK(step(ms) && expected.status == CONTROLLER_SOLVED);
    controller_drive(&direct, 0.3, 0.0, 0.5);
    for (; ms < CONTROLLER_TICK_0 + 2000; ++ms) {
        if (ms % 100 == 0) say(0.3, 0.0, 0.5);
        CHECK(step(ms) && expected.status == CONTROLLER_SOLVED);
    }
    std::printf("x %.3f y %.3f height %.3f\n", data->qpos[0], data->qpos[1], expected.height);
    softer.friction = 0.9 * friction;
    controller_set_tunables(&direct, &softer);
    CHECK(set("friction", {softer.friction}).successful);
    CHECK(set("friction", {-1.0}).reason == "friction: not within the bounds of controller.c");
    CHECK(!set("friction", {0.5, 0.5}).successful && !set("friction", {NAN}).successful);
    CHECK(set("imu_of_another", {}).successful);
    say(NAN, 0.0, 0.0); // no Twist at all
    for (const int64_t until = ms + 401; ms < until; ++ms) CHECK(step(ms));
    CHECK(direct.targets.tunables.friction == softer.friction);
    controller_drive(&direct, 0.0, 0.0, 0.0); // half a second after the last one
    for (const int64_t until = ms + 400; ms < until; ++ms) CHECK(step(ms) && expected.status == CONTROLLER_SOLVED);
    CHECK(direct.command.velocity[0][0] == 0.0);
    CHECK(plugin->on_deactivate({}) == CallbackReturn::SUCCESS);
    for (int j = 0; j < CONTROLLER_JOINTS; ++j) CHECK(effort(j) == 0.0);
    return 0;
}

// A good millisecond at 300, then one of faults; the joints damp until it is activated again.
static int test_fault(int kind)
{
    int64_t ms = 0;
    CHECK(begin());
    for (; ms <= 300; ++ms) CHECK(step(ms) && expected.status == CONTROLLER_SOLVED);
    if (kind == 0) ms += CONTROLLER_MAX_AGE + 1; // an update that is late
    if (kind == 1) ms = -3600000; // a clock that goes back
    if (kind == 2) { // a sensor that is lost
        const double last = effort(3);
        data->qpos[3] = 0.0;
        CHECK(step(ms) && expected.status == CONTROLLER_BAD_INPUT && effort(3) == last);
        ms += CONTROLLER_MAX_AGE;
        mj_resetDataKeyframe(model, data, 0);
        data->qpos[3] = 0.0;
    }
    for (int j = 0; j < 6 + CONTROLLER_JOINTS; ++j) data->qvel[j] = j < 6 ? 0.0 : 1.5;
    CHECK(step(ms) && expected.status == CONTROLLER_UNSAFE);
    for (int j = 0; j < CONTROLLER_JOINTS; ++j)
        CHECK(effort(j) == -1.5 * direct.targets.tunables.kd[j % CONTROLLER_LEG_JOINTS]);
    mj_resetDataKeyframe(model, data, 0);
    CHECK(step(ms + 1) && expected.status == CONTROLLER_UNSAFE && begin());
    CHECK(step(std::abs(ms) + 2) && expected.status == CONTROLLER_SOLVED);
    return 0;
}

int main(int count, char **words)
{
    model = count == 2 ? mj_loadXML(words[1], nullptr, nullptr, 0) : nullptr;
    if (!model) return 2;
    data = mj_makeData(model);
    controller_init(&direct);
    const int failed = test_configuration() || test_walk() || test_fault(0) || test_fault(1) || test_fault(2);
    mj_deleteData(data);
    mj_deleteModel(model);
    return failed;
}
