// SPDX-License-Identifier: Apache-2.0
/// @file `evaluate board` and `evaluate pair`: is a calibration still true?
#pragma once

#include <CLI/CLI.hpp>

namespace omnister::tools {

void addBoard(CLI::App& evaluate);
void addPair(CLI::App& evaluate);

}  // namespace omnister::tools
