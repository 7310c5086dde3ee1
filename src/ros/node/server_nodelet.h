// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <nodelet/nodelet.h>

#include <memory>

#include "ros/node/logger_service.h"

namespace omnister {

/// The nodelet around what is made of the two node handles. Where that fails, loading fails, and
/// the log says why.
template <typename Server>
class ServerNodelet : public nodelet::Nodelet {
 private:
  void onInit() override {
    try {
      server_ = std::make_unique<Server>(getMTNodeHandle(), getMTPrivateNodeHandle());
    } catch (const std::exception& error) {
      NODELET_FATAL("%s", error.what());
      throw;
    }
  }

  const std::shared_ptr<LoggerService> loggers_ = LoggerService::shared();
  std::unique_ptr<Server> server_;
};

}  // namespace omnister
