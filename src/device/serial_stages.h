// SPDX-License-Identifier: Apache-2.0
/// @file The stages on serial ports; see openStage().
#pragma once

#include <memory>
#include <string>

#include "omnister/device/stage.h"

namespace omnister::device {

/// Zaber ASCII protocol, firmware 6.06 and later. Commands carry checksums, and replies are made to
/// (`comm.checksum`, set back when the stage is closed). Without a reference (warnings WR, WH, or
/// after a stall) it only moves relatively.
std::unique_ptr<Stage> openZaberStage(const std::string& port, const StageSettings& settings);

/// GRBL 1.1. Positions are machine coordinates; the origin is what homing sets. GRBL does not say
/// whether it has been homed, so it has not until home() ended well on this connection. Never sends
/// `$X`, and changes no setting.
std::unique_ptr<Stage> openGrblStage(const std::string& port, const StageSettings& settings);

}  // namespace omnister::device
