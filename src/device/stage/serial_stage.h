// SPDX-License-Identifier: Apache-2.0
/// @file The stages on serial ports; see openStage().
#pragma once

#include <memory>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "omnister/device/stage.h"

namespace omnister::device {

/// What is the same for every controller: its name, and what it told.
class SerialStage : public Stage {
 public:
  StageIdentity identity() const override { return identity_; }
  std::vector<std::string> takeRemarks() override { return std::exchange(remarks_, {}); }

 protected:
  void remark(const std::string& text) { remarks_.push_back(text); }
  void remarkOnce(const std::string& text) {
    if (remarked_.insert(text).second) remark(text);
  }

  StageIdentity identity_;

 private:
  std::vector<std::string> remarks_;
  std::set<std::string> remarked_;
};

/// Zaber ASCII protocol, firmware 6.06 and later. Commands carry checksums, and replies are made to
/// (`comm.checksum`, set back when the stage is closed). Without a reference (warnings WR, WH, or
/// after a stall) it only moves relatively.
std::unique_ptr<Stage> openZaberStage(const std::string& port, const StageSettings& settings);

/// GRBL 1.1. Positions are machine coordinates; the origin is what homing sets. GRBL does not say
/// whether it has been homed, so it has not until home() ended well on this connection. Never sends
/// `$X`, and changes no setting.
std::unique_ptr<Stage> openGrblStage(const std::string& port, const StageSettings& settings);

}  // namespace omnister::device
