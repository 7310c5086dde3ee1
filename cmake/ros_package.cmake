# The catkin side of the package: messages, exports, install destinations.
set(OMNISTER_CATKIN_COMPONENTS
  actionlib actionlib_msgs cv_bridge diagnostic_msgs diagnostic_updater dynamic_reconfigure geometry_msgs
  image_transport interactive_markers message_filters message_generation nodelet pluginlib rosbag rosbag_storage roscpp
  sensor_msgs std_msgs std_srvs tf2 tf2_msgs tf2_ros visualization_msgs)
find_package(catkin REQUIRED COMPONENTS ${OMNISTER_CATKIN_COMPONENTS})

file(GLOB OMNISTER_MSG_FILES CONFIGURE_DEPENDS RELATIVE ${PROJECT_SOURCE_DIR}/msg msg/*.msg)
file(GLOB OMNISTER_SRV_FILES CONFIGURE_DEPENDS RELATIVE ${PROJECT_SOURCE_DIR}/srv srv/*.srv)
file(GLOB OMNISTER_ACTION_FILES CONFIGURE_DEPENDS RELATIVE ${PROJECT_SOURCE_DIR}/action action/*.action)
add_message_files(DIRECTORY msg FILES ${OMNISTER_MSG_FILES})
if(OMNISTER_SRV_FILES)
  add_service_files(DIRECTORY srv FILES ${OMNISTER_SRV_FILES})
endif()
add_action_files(DIRECTORY action FILES ${OMNISTER_ACTION_FILES})
generate_messages(DEPENDENCIES actionlib_msgs geometry_msgs sensor_msgs std_msgs)
file(GLOB OMNISTER_CFG_FILES CONFIGURE_DEPENDS RELATIVE ${PROJECT_SOURCE_DIR} cfg/*.cfg)
generate_dynamic_reconfigure_options(${OMNISTER_CFG_FILES})

catkin_package(
  INCLUDE_DIRS include
  LIBRARIES omnister_core omnister_device omnister_sim
  CATKIN_DEPENDS actionlib actionlib_msgs cv_bridge diagnostic_msgs dynamic_reconfigure geometry_msgs image_transport
    message_runtime nodelet roscpp sensor_msgs std_msgs std_srvs tf2_ros visualization_msgs)

set(OMNISTER_BIN_DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})
set(OMNISTER_LIB_DESTINATION ${CATKIN_PACKAGE_LIB_DESTINATION})
set(OMNISTER_INCLUDE_DESTINATION ${CATKIN_PACKAGE_INCLUDE_DESTINATION})
set(OMNISTER_SHARE_DESTINATION ${CATKIN_PACKAGE_SHARE_DESTINATION})
# Executables belong where rosrun finds them, in the devel space too.
set(CMAKE_RUNTIME_OUTPUT_DIRECTORY ${CATKIN_DEVEL_PREFIX}/${CATKIN_PACKAGE_BIN_DESTINATION})

install(DIRECTORY launch config DESTINATION ${OMNISTER_SHARE_DESTINATION})
install(FILES nodelet_plugins.xml DESTINATION ${OMNISTER_SHARE_DESTINATION})
catkin_install_python(PROGRAMS scripts/demo.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})
