// SPDX-License-Identifier: Apache-2.0
/// @file The control channel of an opened camera, and how its failures are told.
#pragma once

#include <atomic>
#include <string>
#include <vector>

#include "device/camera/aravis/aravis_call.h"
#include "device/camera/aravis/aravis_camera.h"

namespace omnister::device {

class AravisConnection {
 public:
  /// @throws CameraError: taken by another program, not permitted, no way to it
  explicit AravisConnection(AravisDevice device, std::vector<std::string> remarks = {});
  /// Closes it; one that is lost or abandoned by a thread that waits for it.
  ~AravisConnection();
  AravisConnection(const AravisConnection&) = delete;
  AravisConnection& operator=(const AravisConnection&) = delete;

  const AravisDevice& device() const { return device_; }
  ArvCamera* camera() const { return camera_.get(); }
  bool gige() const { return device_.protocol == "GigEVision"; }
  /// It streams from this host itself.
  bool local() const { return local_; }

  /// It does not answer any more.
  void abandon() { abandoned_ = true; }
  bool gone() const { return *lost_ || abandoned_; }
  /// @throws CameraError once the connection is lost
  void requireAlive() const;
  /// Ends a stream of a camera that is gone, which takes seconds, without waiting for that.
  void closeLater(Object<ArvStream> stream);

  bool has(const char* feature) const;
  /// @throws CameraError for a failure of the connection, or of anything else
  void refuseIf(const Failure& failure, const std::string& what) const;
  /// A setting that did not work is told. @return whether it failed
  /// @throws CameraError when the camera does not answer
  bool tellIf(const Failure& failure, const std::string& what);

  void remark(std::string text) { remarks_.push_back(std::move(text)); }
  void detail(std::string text) { details_.push_back(std::move(text)); }
  std::vector<std::string> takeRemarks() { return std::exchange(remarks_, {}); }
  std::vector<std::string> takeDetails() { return std::exchange(details_, {}); }

 private:
  [[noreturn]] void throwBusy() const;
  [[noreturn]] void throwCannotOpen(const std::string& why) const;
  static void onControlLost(ArvDevice* device, gpointer lost);

  const AravisDevice device_;
  std::vector<std::string> remarks_, details_;
  Object<ArvCamera> camera_;
  std::shared_ptr<std::atomic<bool>> lost_ = std::make_shared<std::atomic<bool>>(false);
  bool abandoned_ = false;
  bool local_ = false;
};

}  // namespace omnister::device
