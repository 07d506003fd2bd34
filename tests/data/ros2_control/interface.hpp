// What a transmission uses of ros2_control, with the signatures of humble to rolling, for tests
// where ROS is not installed.
#pragma once

#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

namespace hardware_interface
{
constexpr char HW_IF_POSITION[] = "position";
constexpr char HW_IF_VELOCITY[] = "velocity";
constexpr char HW_IF_EFFORT[] = "effort";

struct JointInfo
{
  std::string name;
  std::vector<std::string> state_interfaces, command_interfaces;
  std::string role;
  double mechanical_reduction = 1.0;
  double offset = 0.0;
};

struct ActuatorInfo : JointInfo {};

struct TransmissionInfo
{
  std::string name, type;
  std::vector<JointInfo> joints;
  std::vector<ActuatorInfo> actuators;
};
}  // namespace hardware_interface

namespace transmission_interface
{
class Handle
{
public:
  Handle(const std::string & prefix, const std::string & interface, double * value)
  : prefix_(prefix), interface_(interface), value_(value) {}
  virtual ~Handle() = default;
  operator bool() const { return value_ != nullptr; }
  const std::string & get_interface_name() const { return interface_; }
  const std::string & get_prefix_name() const { return prefix_; }
  double get_value() const { return *value_; }
  [[nodiscard]] bool set_value(double value) { *value_ = value; return true; }

private:
  std::string prefix_, interface_;
  double * value_;
};

class ActuatorHandle : public Handle { using Handle::Handle; };
class JointHandle : public Handle { using Handle::Handle; };

class Exception : public std::runtime_error { using std::runtime_error::runtime_error; };

class Transmission
{
public:
  virtual ~Transmission() = default;
  virtual void configure(
    const std::vector<JointHandle> & joint_handles,
    const std::vector<ActuatorHandle> & actuator_handles) = 0;
  virtual void actuator_to_joint() = 0;
  virtual void joint_to_actuator() = 0;
  virtual std::size_t num_actuators() const = 0;
  virtual std::size_t num_joints() const = 0;
};

class TransmissionLoader
{
public:
  virtual ~TransmissionLoader() = default;
  virtual std::shared_ptr<Transmission> load(
    const hardware_interface::TransmissionInfo & info) = 0;
};
}  // namespace transmission_interface

// the one plugin of the program, in place of pluginlib
std::shared_ptr<transmission_interface::TransmissionLoader> plugin();
#define PLUGINLIB_EXPORT_CLASS(type, base) \
  std::shared_ptr<base> plugin() { return std::make_shared<type>(); }
