// SPDX-License-Identifier: Apache-2.0
/// @file `evaluate plane`: is depth true over the field?
#pragma once

#include <CLI/CLI.hpp>

namespace omnister::tools {

void addPlane(CLI::App& evaluate);

}  // namespace omnister::tools
