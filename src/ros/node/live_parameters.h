// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <dynamic_reconfigure/Config.h>
#include <ros/console.h>

#include <boost/any.hpp>
#include <cmath>

namespace omnister {

/// dynamic_reconfigure clamps numbers to their range and lets NaN through: it stays as it was.
template <typename Config>
void keepFinite(Config& config, const Config& before) {
  for (const auto& parameter : Config::__getParamDescriptions__()) {
    boost::any value;
    parameter->getValue(config, value);
    const double* number = boost::any_cast<double>(&value);
    if (number == nullptr || std::isfinite(*number)) continue;
    dynamic_reconfigure::Config known;
    parameter->toMessage(known, before);
    parameter->fromMessage(known, config);
    ROS_WARN("%s is not a number: it stays as it was", parameter->name.c_str());
  }
}

}  // namespace omnister
