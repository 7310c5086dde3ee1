// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>

namespace omnister {

/// Called now and then during long work, from the calling thread.
/// @param fraction done, 0 to 1   @param stage what is being done, e.g. "detecting corners"
using Progress = std::function<void(double fraction, const std::string& stage)>;

}  // namespace omnister
