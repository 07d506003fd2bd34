// A hardware component: run a method, actuator values and joint values per line, as binary numbers.
// Arguments: names of the actuators, "--", names of the joints.
#include <cstdio>
#include <cstring>

#include "interface.hpp"

int main(int count, char ** words)
{
  using namespace transmission_interface;
  hardware_interface::TransmissionInfo info;
  bool is_joint = false;
  for (int i = 1; i < count; ++i) {
    if (!std::strcmp(words[i], "--")) {
      is_joint = true;
    } else if (is_joint) {
      info.joints.emplace_back();
      info.joints.back().name = words[i];
    } else {
      info.actuators.emplace_back();
      info.actuators.back().name = "my_" + std::string(words[i]);
      info.actuators.back().role = words[i];
    }
  }
  const std::size_t n = info.actuators.size(), k = info.joints.size();
  std::vector<double> values(3 * (n + k));
  std::vector<ActuatorHandle> actuators;
  std::vector<JointHandle> joints;
  const char * kinds[] = {"position", "velocity", "effort"};
  for (int kind = 0; kind < 3; ++kind) {
    for (std::size_t i = 0; i < n; ++i) {
      actuators.emplace_back(info.actuators[i].name, kinds[kind], &values[kind * n + i]);
    }
    for (std::size_t i = 0; i < k; ++i) {
      joints.emplace_back(info.joints[i].name, kinds[kind], &values[3 * n + kind * k + i]);
    }
  }
  try {
    const auto transmission = plugin()->load(info);
    transmission->configure(joints, actuators);
    double method;
    while (std::fread(&method, sizeof method, 1, stdin) == 1 &&
           std::fread(values.data(), sizeof(double), values.size(), stdin) == values.size()) {
      double status = 1.0;
      try {
        method > 0.0 ? transmission->actuator_to_joint() : transmission->joint_to_actuator();
      } catch (const Exception & error) {
        std::fprintf(stderr, "%s\n", error.what());
        status = 0.0;
      }
      std::fwrite(&status, sizeof status, 1, stdout);
      std::fwrite(values.data(), sizeof(double), values.size(), stdout);
    }
  } catch (const Exception & error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
  return 0;
}
