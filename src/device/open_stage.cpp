// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "device/stage/serial_stage.h"
#include "omnister/common/numbers.h"
#include "omnister/device/stage.h"

namespace omnister::device {

std::unique_ptr<Stage> openStage(const std::string& device, const StageSettings& settings) {
  const auto refuse = [](const char* key, const std::string& problem) {
    throw InputError("stage", key, problem);
  };
  if (!std::isfinite(settings.unit_m) || std::abs(settings.unit_m) > 1.0) {
    refuse("unit_m", "is " + formatNumber(settings.unit_m) + ", expected -1 to 1 m");
  }
  if (settings.baud < 0) refuse("baud", "is negative");
  if (settings.device_number < 1 || settings.device_number > 99) {
    refuse("device_number", "is " + std::to_string(settings.device_number) + ", expected 1 to 99");
  }
  if (settings.axis_number < 1 || settings.axis_number > 9) {
    refuse("axis_number", "is " + std::to_string(settings.axis_number) + ", expected 1 to 9");
  }
  const std::size_t colon = device.find(':');
  const std::string backend = device.substr(0, colon);
  const std::string port = colon == std::string::npos ? "" : device.substr(colon + 1);
  if (!port.empty() && backend == "zaber") return openZaberStage(port, settings);
  if (!port.empty() && backend == "grbl") return openGrblStage(port, settings);
  throw InputError("stage", "device",
                   "is \"" + printable(device) + "\", expected zaber:PORT or grbl:PORT");
}

}  // namespace omnister::device
