// A stand-in for tests: of ros2_control and rclcpp what the exported plug-in uses, as they declare it.
#pragma once

#include <cstdint>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::printf(__VA_ARGS__), std::puts(""))

namespace rcl_interfaces::msg
{
struct SetParametersResult { bool successful = false; std::string reason; };
} // namespace rcl_interfaces::msg

namespace rclcpp
{
using Value = std::variant<double, std::string, std::vector<double>>;

class Parameter
{
public:
    Parameter(const std::string &name, const Value &value) : name_(name), value_(value) {}
    const std::string &get_name() const { return name_; }
    double as_double() const { return std::get<double>(value_); }
    const std::string &as_string() const { return std::get<std::string>(value_); }
    const std::vector<double> &as_double_array() const { return std::get<std::vector<double>>(value_); }

private:
    std::string name_;
    Value value_;
};

class Duration
{
public:
    explicit Duration(std::int64_t nanoseconds) : nanoseconds_(nanoseconds) {}
    std::int64_t nanoseconds() const { return nanoseconds_; }
    double seconds() const { return 1e-9 * static_cast<double>(nanoseconds_); }

private:
    std::int64_t nanoseconds_;
};

class Time
{
public:
    explicit Time(std::int64_t nanoseconds = 0) : nanoseconds_(nanoseconds) {}
    Duration operator-(const Time &other) const { return Duration(nanoseconds_ - other.nanoseconds_); }

private:
    std::int64_t nanoseconds_;
};

struct SystemDefaultsQoS {};
struct Logger {};

template <class Message> struct Subscription
{
    using SharedPtr = std::shared_ptr<Subscription>;
    std::function<void(const Message &)> callback;
};

namespace node_interfaces
{
struct OnSetParametersCallbackHandle
{
    using SharedPtr = std::shared_ptr<OnSetParametersCallbackHandle>;
    std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<Parameter> &)> callback;
};
} // namespace node_interfaces
} // namespace rclcpp

namespace rclcpp_lifecycle
{
struct State {};

class LifecycleNode
{
public:
    std::map<std::string, rclcpp::Value> values; // overrides, then what is declared
    std::map<std::string, std::shared_ptr<void>> topics;
    std::weak_ptr<rclcpp::node_interfaces::OnSetParametersCallbackHandle> on_set;

    rclcpp::Logger get_logger() const { return {}; }
    rclcpp::Parameter get_parameter(const std::string &name) const { return {name, values.at(name)}; }

    template <class Callback> auto add_on_set_parameters_callback(Callback callback)
    {
        using rclcpp::node_interfaces::OnSetParametersCallbackHandle;
        const auto handle = std::make_shared<OnSetParametersCallbackHandle>();
        handle->callback = callback;
        on_set = handle;
        return handle;
    }

    template <class Message, class Callback>
    auto create_subscription(const std::string &topic, const rclcpp::SystemDefaultsQoS &, Callback callback)
    {
        const auto subscription = std::make_shared<rclcpp::Subscription<Message>>();
        subscription->callback = callback;
        topics[topic] = subscription;
        return subscription;
    }
};
} // namespace rclcpp_lifecycle

namespace hardware_interface
{
class Loaned
{
public:
    Loaned(const std::string &name, double *value) : name_(name), value_(value) {}
    const std::string &get_name() const { return name_; }
    double get_value() const { return *value_; }
    [[nodiscard]] bool set_value(double value) { return *value_ = value, true; }

private:
    std::string name_;
    double *value_;
};
} // namespace hardware_interface

namespace controller_interface
{
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };

struct InterfaceConfiguration
{
    interface_configuration_type type;
    std::vector<std::string> names;
};

class ControllerInterface
{
public:
    virtual ~ControllerInterface() = default;
    virtual CallbackReturn on_init() = 0;
    virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) = 0;
    virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
    virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) = 0;
    virtual InterfaceConfiguration command_interface_configuration() const = 0;
    virtual InterfaceConfiguration state_interface_configuration() const = 0;
    virtual return_type update(const rclcpp::Time &, const rclcpp::Duration &) = 0;
    std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() { return node_; }

    std::vector<hardware_interface::Loaned> command_interfaces_, state_interfaces_; // here to be filled

protected:
    template <class Type> Type auto_declare(const std::string &name, const Type &value)
    {
        node_->values.emplace(name, value);
        return std::get<Type>(node_->values.at(name));
    }

private:
    std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node_ =
        std::make_shared<rclcpp_lifecycle::LifecycleNode>();
};
} // namespace controller_interface
